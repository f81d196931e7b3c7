# `make run` and `make test` are all it takes: both first set up what is missing in .venv.
# Another interpreter: make run PYTHON=python3.12

PYTHON ?= python3
BIN := .venv/bin
# make test SEED=1234 repeats the order of an earlier run within each file.
PYTEST = $(BIN)/python -m pytest $(if $(SEED),--randomly-seed=$(SEED))
SIDE_BY_SIDE = --numprocesses 4 --dist loadfile
# A platform has two CPUs to itself: its processes take CPU time before all that is not in real time.
PLATFORMS := $(shell expr \( $$(nproc) + 1 \) / 2)
ON_PLATFORMS = --numprocesses $(PLATFORMS) --dist loadfile
# Empty is off: a platform's processes start in half the time where Python keeps what it has compiled.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help setup oracles run panel check test test-all test-flaky test-arms test-ros mutants fast faults lint format clean
.DEFAULT_GOAL := help

help: ## show this list
	@sed -n 's/^\([a-z-]*\):[^#]*## \(.*\)/  make \1|\2/p' Makefile | awk -F'|' '{ printf "%-16s%s\n", $$1, $$2 }'

setup: ## make .venv with the package and what it needs
	@sh .ci/setup "$(PYTHON)"

oracles: setup ## add what the kinematics is compared with (Pinocchio, EAIK); without it those tests are skipped
	@sh .ci/install .venv --editable '.[dev,oracles]'

run: setup ## run the demonstration: virtual segment, master, a move, the figures
	@$(BIN)/rtcp demo --square xy

panel: setup ## run the virtual arm with the panel: http://127.0.0.1:8080 in a browser
	@$(BIN)/rtcp start --panel

check: lint ## check style, format and types, and run the tests that need no platform: before each commit
	@$(PYTEST) -m 'not platform and not long' $(SIDE_BY_SIDE)

test: setup ## run all tests but those marked long
	@$(PYTEST) -m 'not platform and not long' $(SIDE_BY_SIDE)
	@$(PYTEST) -m 'platform and not long' $(ON_PLATFORMS)

test-all: oracles ## run all tests, with every sample
	@RTCP_THOROUGH=1 $(PYTEST) -m 'not platform' $(SIDE_BY_SIDE)
	@RTCP_THOROUGH=1 $(PYTEST) -m platform $(ON_PLATFORMS)

test-flaky: setup ## run all tests but the long ones five times on a busy host: no verdict may change
	@$(BIN)/python -m tests.flaky $(if $(SEED),--seed $(SEED)) -- -m 'not long' $(ON_PLATFORMS)

test-arms: setup ## run the end-to-end tests of the arm with the drives of each other arm (tests/drive_esi.py)
	@status=0; \
	for arm in two-axis myactuator synapticon; do \
		echo "== $$arm"; \
		RTCP_TEST_ARM=$$arm $(BIN)/python -m pytest tests/e2e -m 'platform and not long' \
			-k 'not test_abb and not test_cell and not test_heater and not test_shape and not test_systemd' || status=1; \
	done; \
	exit $$status

test-ros: setup ## run the tests on ROS 1 and ROS 2 in network namespaces; as root on Debian 12 both are installed first
	@sh .ci/ros
	@$(BIN)/python -m pytest tests/ros1 tests/ros2
	@sh .ci/test-ros2

mutants: setup ## put small mistakes into a copy, and list those that no test notices; FILE=, SEED=, COUNT=
	@$(BIN)/python -c 'import cosmic_ray' 2>/dev/null || sh .ci/install .venv --editable '.[dev,mutants]'
	@$(BIN)/python -m tests.mutants.run $(if $(FILE),--file $(FILE)) $(if $(SEED),--seed $(SEED)) $(if $(COUNT),--count $(COUNT))

fast: setup ## compile the cycle in place: about half the time for each; needs a C compiler, takes minutes
	@$(BIN)/python hatch_build.py

faults: setup ## carry out the whole fault matrix and print it as a table
	@$(BIN)/python benchmarks/faults.py

lint: setup ## check style, format and types
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/python -m mypy

format: setup ## put imports and layout in order
	@$(BIN)/ruff check --select I --fix .
	@$(BIN)/ruff format .

clean: ## remove .venv and all else that can be made again
	rm -rf .venv .venv-egm-peers .venv-foreign .venv-ros2 build dist kinematics/_fast .mypy_cache .ruff_cache .pytest_cache .hypothesis .mutants
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
