"""The command `gsseg`: a table of its commands, each in a module of its own, and what their errors become."""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Sequence
from importlib.metadata import version
from types import ModuleType

from gsseg_core import (
    cli_completion,
    cli_demo,
    cli_doctor,
    cli_eval,
    cli_pick,
    cli_remove,
    cli_render,
    cli_segment,
    cli_view,
)
from gsseg_core.errors import GssegError
from gsseg_core.freed_memory import keep_freed_memory

_INTERRUPTED = 130

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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 2 on an error of the input, 130 when interrupted."""
    options = build_parser().parse_args(arguments)
    keep_freed_memory()
    try:
        code: int = options.run(options)
    except GssegError as error:
        print(f"gsseg: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ngsseg: interrupted; nothing that was saved before has changed", file=sys.stderr)
        return _INTERRUPTED
    except BrokenPipeError:
        # The reader of our output has left, as `head` does; there is nobody to tell.
        sys.stderr.close()
        return 0
    return code


def build_parser() -> argparse.ArgumentParser:
    """Build the parser of the whole command line, from which help, tab completion and docs/ are made, too."""
    parser = argparse.ArgumentParser(
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


if __name__ == "__main__":
    sys.exit(main())
