"""docs/your_own_arm.md, followed literally with a shell in an empty folder: the drives of an unknown ESI file move."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.test_arm_new import block, commands, fill_in, folder
from tests.e2e.conftest import Platform

__all__ = ["folder"]
pytestmark = [
    pytest.mark.platform,
    pytest.mark.long("test_the_page_leads_from_an_unknown_esi_file_to_an_arm_whose_joints_turn_as_commanded"),
]


def test_the_commands_of_the_page_move_a_simulated_arm(platform: Platform, folder: Path) -> None:
    def follow(*titles: str) -> str:
        lines = [line for title in titles for line in commands(title)]
        script = f'set -e\nrtcp() {{ {sys.executable} -m rtcp.cli "$@"; }}\n' + "\n".join(lines)
        done = subprocess.run(
            ["bash", "-c", script], env=platform.environment, text=True, capture_output=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr + platform.logs()
        return done.stdout

    (folder / "devices").mkdir()
    follow("The drive")
    fill_in(folder / "devices" / "my-drive.yaml")
    (folder / "numbers.yaml").write_text(block("position_min"), encoding="utf-8")
    shown = follow("The arm", "It moves")
    assert len(re.findall(r"joint\d +\+0\.1000 .*\+0\.1000$", shown, re.MULTILINE)) == 6
