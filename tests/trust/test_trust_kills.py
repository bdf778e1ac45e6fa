"""A few of the kills and meetings that ``kills.py`` makes hundreds of."""

from __future__ import annotations

import random

import pytest
from trust.kills import COMMANDS, Place, killed, met, prepare

KILLS, PAIRS = 20, 4

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    at = tmp_path_factory.mktemp("kills")
    prepare(at)
    return [Place(name, at).begin() for name in COMMANDS]


@pytest.mark.parametrize("index", range(KILLS))
def test_a_killed_command_leaves_the_old_result_or_the_new_one(places, index):
    place = places[index % len(places)]
    assert killed(place, random.Random(index), place.at / "again" / place.name) in ("old", "new")


@pytest.mark.parametrize("index", range(PAIRS))
def test_of_two_commands_in_one_folder_one_writes(places, index):
    assert met(places[index], places[index].at / "again" / places[index].name) in ("one", "both")
