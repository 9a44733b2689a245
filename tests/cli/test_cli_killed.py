"""A killed command leaves nothing in the way of its restart; a small part of ``python tests/kill_campaign.py``."""

from __future__ import annotations

import pytest
from kill_campaign import COMMANDS, Command, Moment, campaign, kill_at


def test_a_killed_repair_starts_again(tmp_path):
    command = next(command for command in COMMANDS if command.name == "repair")
    assert kill_at(command, tmp_path, moment=Moment(cpu_s=1.5)) == ""


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_every_restart_completes(command: Command) -> None:
    assert campaign(command, moments=10, seed=2) == {}
