"""The command `gsseg demo`."""

from __future__ import annotations

import argparse

from gsseg_core.cli.shared import add_quiet, load_kernels
from gsseg_core.cli.terminal import tell
from gsseg_core.progress import progress_bars

DESCRIPTION = """
Makes a scene (a table with eight objects), posed views, and masks with realistic errors; segments the scene, and
scores the result against the truth. Needs no data.
"""
EXAMPLES = """
  gsseg demo
  gsseg demo --out /tmp/table --seed 7
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    parser.add_argument("--out", default="demo_out", metavar="DIR", help="folder to write to (default: %(default)s)")
    seed = "seed of the scene and of its masks' errors (default: %(default)s)"
    parser.add_argument("--seed", type=int, default=0, help=seed)
    add_quiet(parser)


def run(options: argparse.Namespace) -> int:
    """Build the scene, segment it, and print tables."""
    from gsseg_core.demo.run import run_demo

    load_kernels(options.quiet)
    with progress_bars(options.quiet) as progress:
        summary = run_demo(options.out, seed=options.seed, progress=progress)
    tell(summary)
    return 0
