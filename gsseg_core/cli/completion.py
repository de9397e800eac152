"""The command `gsseg completion`."""

from __future__ import annotations

import argparse

from gsseg_core.cli.terminal import tell
from gsseg_core.errors import SettingsError

SHELLS = ("bash", "zsh", "fish")

DESCRIPTION = """
Prints a script that completes commands, options, their choices, files and folders. Print it again after an update of
gsseg.
"""
EXAMPLES = """
  bash: gsseg completion bash > ~/.local/share/bash-completion/completions/gsseg
  zsh:  gsseg completion zsh > ~/.zfunc/_gsseg     (with ~/.zfunc in fpath)
  fish: gsseg completion fish > ~/.config/fish/completions/gsseg.fish
"""

_FOLDERS = {"DIR", "DATASET", "OUT"}
_FILES = {"FILE", "SCENE", "STATE", "PATH"}  # and folders, too


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    parser.add_argument("shell", choices=SHELLS, help="your shell")


def run(options: argparse.Namespace) -> int:
    """Print the script."""
    from gsseg_core.cli.arguments import build_parser

    try:
        import shtab
    except ImportError as error:
        raise SettingsError("completion scripts are made by shtab, which is missing: pip install shtab") from error
    parser = build_parser()
    for command in subparsers(parser).values():
        for action in command._actions:
            # What a placeholder stands for is what the shell shall offer.
            if action.metavar in _FOLDERS | _FILES:
                action.complete = shtab.DIRECTORY if action.metavar in _FOLDERS else shtab.FILE  # type: ignore[attr-defined]
    tell(shtab.complete(parser, shell=options.shell))
    return 0


def subparsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of the commands by name; argparse has no public way to them."""
    actions = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    return dict(next(actions).choices)
