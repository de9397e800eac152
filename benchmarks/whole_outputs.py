"""Whether the files of a folder of results are whole, of which run each is, and what lies about beside them."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from gsseg_core.scene.gaussian_scene import GaussianScene

Fault = tuple[str, str]
"""Its kind, to count by, and what was found."""


@dataclass(frozen=True)
class Read:
    """What a file says.

    Attributes
    ----------
    content : str
        Hash of what it says of the scene; times and the run's id are left out.
    run : str
        Id of the run that wrote it; "" where it has none.
    """

    content: str
    run: str


def read_whole(path: Path) -> Read:
    """Read a file of results to its end; raises whatever its reader raises where it is not whole."""
    return {".npz": _npz, ".ply": _ply, ".png": _png, ".json": _json, ".html": _html}[path.suffix](path)


def results(folder: Path) -> dict[str, Path]:
    """Files of results in a folder, by their names in it; hidden ones are not results."""
    found = (Path(top) / name for top, _, names in os.walk(folder, followlinks=True) for name in names)
    named = {str(path.relative_to(folder)): path for path in found}
    return {name: path for name, path in sorted(named.items()) if not any(p.startswith(".") for p in Path(name).parts)}


def read_folder(folder: Path) -> dict[str, Read]:
    """Read all results of a folder that is whole."""
    return {name: read_whole(path) for name, path in results(folder).items()}


def faults_of(folder: Path, runs: Mapping[str, Mapping[str, Read]]) -> list[Fault]:
    """Say what is wrong with a folder that should hold what exactly one of some runs wrote.

    Parameters
    ----------
    folder : pathlib.Path
        Where results should be.
    runs : mapping from name to mapping from file to Read
        What each run writes if it is left alone; of each file the runs write something else.

    Returns
    -------
    list of Fault
        Of the kinds "lost", "broken", "mixed" (files of two runs), and "unmarked" (files that name no run).
    """
    files, faults, origin = results(folder), list[Fault](), dict[str, str]()
    ids: dict[str, set[str]] = {}
    wanted = set.intersection(*(set(run) for run in runs.values()))
    missing = sorted(wanted - set(files))
    if missing:
        faults.append(("lost", f"no {', '.join(missing[:4])} ({len(missing)} of {len(wanted)} files)"))
    for name, path in files.items():
        try:
            read = read_whole(path)
        except Exception as error:  # Whatever a reader makes of half a file.
            faults.append(("broken", f"{name}: {type(error).__name__}: {error}"))
            continue
        # An image of nothing may look the same in every run.
        writers = [run for run, written in runs.items() if name in written and written[name].content == read.content]
        if len(writers) < len(runs):
            origin[name] = writers[0] if writers else "none of the runs"
        ids.setdefault(read.run, set()).add(name)
    faults += _mixed("", {run: {n for n, of in origin.items() if of == run} for run in set(origin.values())})
    faults += _mixed("run id ", {run: names for run, names in ids.items() if run})
    if "" in ids:
        faults.append(("unmarked", f"{len(ids[''])} of {len(files)} files name no run, such as {min(ids[''])}"))
    return faults


def _mixed(what: str, groups: Mapping[str, set[str]]) -> list[Fault]:
    if len(groups) < 2:
        return []
    shown = "; ".join(f"{what}{run}: {', '.join(sorted(names)[:3])}" for run, names in sorted(groups.items()))
    return [("mixed", shown)]


def listing(folder: Path) -> Counter[str]:
    """Names of everything in a folder, hidden or not; what is drawn at random in a name is left out."""
    names = Counter[str]()
    for top, folders, files in os.walk(folder):
        for name in (*folders, *files):
            relative = str((Path(top) / name).relative_to(folder))
            names[re.sub(r"[0-9a-f]{8,}", "*", relative)] += 1
    return names


def leftovers(folder: Path, clean: Counter[str]) -> list[Fault]:
    """Name what is in a folder beyond what is there when nothing was ever killed."""
    more = sorted((listing(folder) - clean).elements())
    return [("leftover", f"{', '.join(more[:4])} ({len(more)} in all)")] if more else []


def hash_of(*parts: bytes) -> str:
    """Hash of some bytes."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()[:16]


def _npz(path: Path) -> Read:
    # Opened here, since np.load leaves a file open that it cannot read.
    with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
        header = json.loads(str(file["header"]))
        arrays = [(name, file[name]) for name in sorted(file.files) if name != "header"]
    content = hash_of(*(f"{name}{array.shape}{array.dtype}".encode() + array.tobytes() for name, array in arrays))
    return Read(content, str(header.get("run") or ""))


def _ply(path: Path) -> Read:
    GaussianScene.load(path)
    header, _, body = path.read_bytes().partition(b"end_header\n")
    run = re.search(rb"comment gsseg_run[: ]+(\S+)", header)
    return Read(hash_of(body), run[1].decode() if run else "")


def _png(path: Path) -> Read:
    with Image.open(path) as image:
        image.load()
        texts = {key.lower(): value for key, value in getattr(image, "text", {}).items()}
        return Read(hash_of(str(image.size).encode(), image.tobytes()), str(texts.get("gsseg_run", "")))


def _json(path: Path) -> Read:
    said = json.loads(path.read_text())
    content = [[entry["name"], entry["gaussians"], entry["mean_confidence"]] for entry in said["classes"]]
    return Read(hash_of(json.dumps(content).encode()), str(said.get("run") or ""))


def _html(path: Path) -> Read:
    text = path.read_text()
    if not text.rstrip().endswith("</html>"):
        raise ValueError("does not end with </html>")
    run = re.search(r'<meta name="gsseg[-_]run" content="([^"]+)"', text)
    records = re.search(r'id="preview-records"[^>]*>([^<]*)<', text)
    return Read(hash_of(records[1].encode() if records else b""), run[1] if run else "")
