"""What the command line takes: a table of its commands, each in a module of its own, and the parser made from it."""

from __future__ import annotations

import argparse
import difflib
import re
import textwrap
from collections.abc import Sequence
from importlib.metadata import version
from types import ModuleType
from typing import Any

from gsseg_core.cli import completion as cli_completion
from gsseg_core.cli import demo as cli_demo
from gsseg_core.cli import doctor as cli_doctor
from gsseg_core.cli import eval as cli_eval
from gsseg_core.cli import pick as cli_pick
from gsseg_core.cli import remove as cli_remove
from gsseg_core.cli import render as cli_render
from gsseg_core.cli import segment as cli_segment
from gsseg_core.cli import view as cli_view

# In the order of `gsseg --help`. A command's module has HELP, one line; DESCRIPTION; EXAMPLES; `add_arguments(parser)`;
# and `run(options)`, which returns the exit code. All that is slow to import is imported in `run`, so that
# `gsseg --help` is at once.
COMMANDS: dict[str, ModuleType] = {
    "segment": cli_segment,
    "render": cli_render,
    "eval": cli_eval,
    "pick": cli_pick,
    "view": cli_view,
    "remove": cli_remove,
    "demo": cli_demo,
    "doctor": cli_doctor,
    "completion": cli_completion,
}

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
            # What follows these has an option's look, but need not be one.
            if argument == "--" or (self._subparsers and not argument.startswith("-")):
                return
            name = argument.split("=")[0]
            if not re.match(r"--?[A-Za-z]\S*$", name) or any(option.startswith(name) for option in known):
                continue
            near = difflib.get_close_matches(name, known, 1)
            self.error(f"unknown option {name}" + (f"; did you mean {near[0]}?" if near else ""))


def build_parser() -> argparse.ArgumentParser:
    """Build the parser of the whole command line, from which help, tab completion and docs/ are made, too."""
    parser = _Parser(
        prog="gsseg",
        description="Segment a trained 3D Gaussian Splatting scene, all objects at once, from\nposed 2D masks.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"gsseg {version('gsseg')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, module in COMMANDS.items():
        command = commands.add_parser(
            name,
            help=module.HELP,
            description=textwrap.fill(" ".join(module.DESCRIPTION.split()), 78),
            epilog=f"examples:\n{module.EXAMPLES.strip(chr(10))}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    return parser
