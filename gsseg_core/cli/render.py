"""The command `gsseg render`."""

from __future__ import annotations

import argparse

from gsseg_core.cli.shared import add_scene, load_kernels, note_frame
from gsseg_core.cli.terminal import tell
from gsseg_core.progress import progress_bars
from gsseg_core.text import counted

DESCRIPTION = """
Renders the label map of each view of a split as DIR/<stem>.png (16 bits if 8 cannot hold the ids), and overlays on the
scene in DIR/overlays. Needs no masks.
"""
EXAMPLES = """
  gsseg render scene.ply --data DATASET --segmentation out/segmentation.npz \\
               --out rendered
  gsseg render scene.ply --data DATASET --segmentation out/segmentation.npz \\
               --out rendered --split all
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    add_scene(parser)
    parser.add_argument("--segmentation", required=True, metavar="FILE", help="segmentation.npz of this scene")
    parser.add_argument("--split", choices=("train", "test", "all"), default="test", help="default: test")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder to write to")


def run(options: argparse.Namespace) -> int:
    """Render, and say what was written."""
    from gsseg_core import pipeline

    load_kernels(options.quiet, options.device)
    with progress_bars(options.quiet) as progress:
        paths = pipeline.render(
            options.scene, options.data, options.segmentation, options.out,
            split=options.split, device=options.device, align=options.align,
            dataparser=options.dataparser, progress=progress,
        )  # fmt: skip
    note_frame(options)
    tell(f"{counted(len(paths), 'label map')} in {options.out}, overlays in {options.out}/overlays")
    return 0
