"""YAML files as they come from users, where PyYAML is installed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsseg_core.errors import GssegError, SettingsError
from gsseg_core.files.input_files import DAMAGED, read_input
from gsseg_core.text import clipped

_MOST_BYTES = 2**20


def read_yaml(path: Path, error: type[GssegError], within: Path | None = None) -> Any:
    """Read a YAML file, below `within` if given; raise `error` if it is missing, broken, or larger than any is.

    Anchors are refused: a few lines with them can stand for more than memory holds. Raises `SettingsError` where PyYAML
    is not installed.
    """
    try:
        import yaml
    except ModuleNotFoundError as missing:
        raise SettingsError(f"{path}: needs PyYAML, which is missing: pip install 'gsseg[formats]'") from missing
    content = read_input(path, error, within, _MOST_BYTES)
    try:
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(content, yaml.SafeLoader)):
            raise error(f"{path}: uses anchors, as in *name; expected YAML without")
        return yaml.load(content, yaml.SafeLoader)
    except (yaml.YAMLError, *DAMAGED) as cause:  # PyYAML trips over values such as `!!bool 7` itself.
        raise error(f"{path}: not valid YAML ({clipped(cause, 160)})") from cause
