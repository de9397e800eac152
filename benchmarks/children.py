"""Jobs that need a process of their own: a cold start, a peak of memory, or a library that others should not see.

`run_child` starts one and returns what it answers. The answer is one line of JSON, the last that it prints.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

PATIENCE = 1200.0  # s


class ChildError(RuntimeError):
    """A child failed; the message is its last words."""


def run_child(job: str, *, python: str | Path = sys.executable, patience: float = PATIENCE, **arguments: Any) -> Any:
    """Run `module.function` of this folder in a new process, and return its answer.

    Raises
    ------
    ChildError
        It failed, or took too long.
    """
    command = [str(python), str(Path(__file__).resolve()), job, json.dumps(arguments, default=str)]
    return json.loads(finish(command, patience).splitlines()[-1])


def finish(command: list[str], patience: float = PATIENCE, **environment: str) -> str:
    """Run a command and return what it prints.

    Raises
    ------
    ChildError
        It failed, or took too long.
    """
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=patience, env={**os.environ, **environment}
        )
    except subprocess.TimeoutExpired as error:
        raise ChildError(f"not done after {patience:.0f} s") from error
    if done.returncode:
        raise ChildError(last_words(done.stderr) or last_words(done.stdout) or f"exit code {done.returncode}")
    return done.stdout


def last_words(text: str) -> str:
    """Last line that says something, without the paths and hosts that only this machine has."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    words = re.sub(r"\w+://\S+|host='[^']*'", "...", (lines or [""])[-1])
    return re.sub(r"(?:/[\w.+-]+)+/([\w.+-]+)", r"\1", words)[:200].rstrip(".")


def seconds_of(command: list[str], **environment: str) -> float:
    """Seconds that a command takes, from start to end."""
    start = time.perf_counter()
    finish(command, **environment)
    return time.perf_counter() - start


def main() -> None:
    """Do the job and print the answer."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("job", help="module.function")
    parser.add_argument("arguments", help="its keyword arguments, as JSON")
    options = parser.parse_args()
    module, function = options.job.rsplit(".", 1)
    answer = getattr(importlib.import_module(module), function)(**json.loads(options.arguments))
    print(json.dumps(answer))


if __name__ == "__main__":
    main()
