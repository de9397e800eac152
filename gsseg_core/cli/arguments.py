"""What the command line takes: a table of its commands, each in a module of its own, and the parser made from it."""

from __future__ import annotations

import argparse
import importlib
import re
import textwrap
from collections.abc import Collection, Sequence
from types import ModuleType
from typing import Any

COMMANDS = {
    "segment": "learn from masks, refine, write labels and one PLY per object",
    "render": "render label maps and overlays of a segmentation",
    "eval": "score label maps: mIoU, mAcc, boundary IoU",
    "pick": "pick one object by its mask in one or a few views, and write it as a PLY",
    "view": "view a scene in the browser, class by class, and correct labels",
    "remove": "write the scene without some of its objects",
    "merge": "merge what several robots have learnt about one scene",
    "demo": "make a small scene with known truth and segment it",
    "doctor": "show what this machine has, what it lacks, and how to install that",
    "completion": "print a script for tab completion",
}
"""Each command and its line in `gsseg --help`, in this order.

The module of its name has DESCRIPTION; EXAMPLES; `add_arguments(parser)`; and `run(options)`, which returns the exit
code. It is imported only for a command that is given, and imports in `run` what is slow to import.
"""

_EPILOG = """\
first steps:
  gsseg demo                   a small scene with known truth, segmented
  gsseg doctor                 what this machine has and lacks
  gsseg COMMAND --help         what a command takes, with examples
"""


class _Parser(argparse.ArgumentParser):
    """A parser that names an option it does not know before it asks for those that are missing."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse unknown options, then parse."""
        if args is not None:
            self._refuse_unknown(args)
        return super().parse_known_args(args, namespace)

    def _refuse_unknown(self, arguments: Sequence[str]) -> None:
        known = list(self._option_string_actions)
        for argument in arguments:
            # What follows these may look like an option without being one.
            if argument == "--" or (self._subparsers and not argument.startswith("-")):
                return
            name = argument.split("=")[0]
            if not re.match(r"--?[A-Za-z]\S*$", name) or any(option.startswith(name) for option in known):
                continue
            import difflib

            shown = [option for option in known if self._option_string_actions[option].help != argparse.SUPPRESS]
            near = difflib.get_close_matches(name, shown, 1)
            self.error(f"unknown option {name}" + (f"; did you mean {near[0]}?" if near else ""))


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(f"gsseg {version('gsseg')}")
        parser.exit()


def command_module(name: str) -> ModuleType:
    """Import the module of a command."""
    return importlib.import_module(f"gsseg_core.cli.{name}")


def build_parser(full: Collection[str] = COMMANDS.keys()) -> argparse.ArgumentParser:
    """Build the parser of the command line, from which help, tab completion and docs/ are made, too.

    `full` are the commands whose arguments are needed; the others have only their names.
    """
    parser = _Parser(
        prog="gsseg",
        description="Segment a trained 3D Gaussian Splatting scene, all objects at once, from\nposed 2D masks.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show program's version number and exit")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, line in COMMANDS.items():
        command = commands.add_parser(name, help=line, formatter_class=argparse.RawDescriptionHelpFormatter)
        if name in full:
            module = command_module(name)
            paragraphs = module.DESCRIPTION.split("\n\n")
            command.description = "\n\n".join(textwrap.fill(" ".join(text.split()), 78) for text in paragraphs)
            command.epilog = f"examples:\n{module.EXAMPLES.strip(chr(10))}"
            module.add_arguments(command)
            command.set_defaults(run=module.run)
    return parser
