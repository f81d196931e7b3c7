"""The examples of docs/api.md, run one after the other against the real platform on the virtual bus."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.conftest import Platform

pytestmark = pytest.mark.alone

PAGE = Path(__file__).parents[2] / "docs" / "api.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)


@pytest.fixture(scope="module")
def platform() -> Iterator[Platform]:
    made = Platform()
    made.be_patient(2000)
    made.rtcp("start", "--detach")
    yield made
    made.end()


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_an_example_of_the_page_runs(platform: Platform, number: int) -> None:
    environment = {**os.environ, "RTCP_RUNTIME_DIR": str(platform.directory)}
    done = subprocess.run(
        [sys.executable, "-c", EXAMPLES[number]], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr + platform.logs()
