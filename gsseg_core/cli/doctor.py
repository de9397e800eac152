"""The command `gsseg doctor`."""

from __future__ import annotations

import argparse

from gsseg_core.cli.terminal import note, tell

DESCRIPTION = """
Prints the versions of gsseg, Python and its packages, the devices, whether the kernels run and where they are cached,
the formats of scenes and cameras that are read, which options are installed, and what is there of ROS 2. For everything
that is missing it says what to type. The exit code is 0 if gsseg works without the options, and 2 if not.
"""
EXAMPLES = """
  gsseg doctor
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes: nothing."""


def run(options: argparse.Namespace) -> int:
    """Look, and print what was found."""
    from gsseg_core.cli.machine_check import describe, examine, works

    findings = examine(note)
    tell(describe(findings))
    return 0 if works(findings) else 2
