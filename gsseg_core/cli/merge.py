"""The command `gsseg merge`."""

from __future__ import annotations

import argparse

from gsseg_core.cli.shared import check_not_read
from gsseg_core.cli.terminal import tell

DESCRIPTION = """
Adds up saved states of one scene, which robots save with ~/save_state. Votes are added exactly, as if one robot had
received all masks; views with the same name stay separate. A view that is in two states counts twice, because its votes
cannot be found without the scene; ~/merge_states counts it once. Learnt class probabilities are left out, since each
state learnt them from its own views only: load the result and learn again.
"""
EXAMPLES = """
  gsseg merge first_robot.npz second_robot.npz -o both.npz
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    parser.add_argument("states", metavar="STATE", nargs="+", help="saved state; all must be of the same scene")
    parser.add_argument("-o", "--out", required=True, metavar="FILE", help="state to write")


def run(options: argparse.Namespace) -> int:
    """Merge, and say what came together."""
    from collections import Counter

    from gsseg_core.files.atomic import check_writable
    from gsseg_core.learn.learner_state import State
    from gsseg_core.learn.merged_states import Saved, digests, merge_states
    from gsseg_core.text import counted

    check_writable(options.out)
    for path in options.states:  # The same command once more would count all others twice.
        check_not_read(options.out, "state", path)
    saved = [Saved(path, *State.load_alone(path)) for path in options.states]
    merged = merge_states(saved)
    merged.save(options.out, saved[0].scene)
    tell(f"{counted(merged.num_fused, 'view')} of {counted(len(saved), 'state')}, {len(merged.views):,} with masks: "
         f"{options.out}")  # fmt: skip
    twice = 0
    before = Counter[bytes]()
    for one in saved:
        known = Counter(digests(one.state))
        twice += (known & before).total()
        before += known
    if twice:
        counts = "count" if twice > 1 else "counts"
        tell(f"{counted(twice, 'view')} {counts} twice: of states that one robot has saved, merge the last alone")
    return 0
