"""Checkpoints of PyTorch: those of gsplat's trainer, and of nerfstudio's splatfacto."""

from __future__ import annotations

import pickle
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.files.input_files import OPENED, UnfitError
from gsseg_core.scene.scene_file import open_scene, size_of
from gsseg_core.scene.spherical_harmonics import MAX_DEGREE
from gsseg_core.scene.vertices import SH_LEFT_OUT, ReadScene, dc_of, pack_vertices
from gsseg_core.text import quoted

_EXPECTED = "a checkpoint of gsplat or nerfstudio's splatfacto"
_GSPLAT = {"dc": "sh0", "rest": "shN"}
_SPLATFACTO = {"dc": "features_dc", "rest": "features_rest"}
_PREFIXES = ("_model.gauss_params.", "_model.")  # of nerfstudio since 1.0, and before


def is_checkpoint(head: bytes) -> bool:
    """Whether a file begins as a zip of `torch.save`."""
    return head.startswith(b"PK\x03\x04") and b"data.pkl" in head[:256]


def read_checkpoint(path: Path, within: Path | None = None) -> ReadScene:
    """Read the Gaussians of a checkpoint; nothing in it is executed (`weights_only`)."""
    with open_scene(path, within, _EXPECTED) as file:
        with zipfile.ZipFile(file) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise UnfitError("is compressed, which torch.save never does; expected a checkpoint as it was saved")
        size = size_of(file)
        content = _load(f"{OPENED}/{file.fileno()}")
        tensors, names = _find(content)
        arrays = {name: _array(tensors, name, size) for name in ("means", "scales", "quats", "opacities")}
        dc, rest = (_array(tensors, names[part], size) for part in ("dc", "rest"))
        vertices = _vertices(arrays, dc, rest, names is _SPLATFACTO)
    remarks = (SH_LEFT_OUT,) if rest.ndim == 3 and rest.shape[1] > 15 else ()
    return ReadScene(vertices, "gsplat" if names is _GSPLAT else "splatfacto", remarks)


def _load(path: str) -> Any:
    import torch  # It takes a second to load, and no other format needs it.

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        raise UnfitError(
            "holds objects that only executing the file would make; expected tensors alone (torch.load, weights_only)"
        ) from error
    except AssertionError as error:  # So PyTorch says what it expects of what is pickled.
        raise ValueError(str(error)) from error


def _find(content: object) -> tuple[Mapping[str, Any], dict[str, str]]:
    """Find the tensors of the Gaussians, and how a program calls the coefficients of SH."""
    if isinstance(content, Mapping):
        splats: Any = content.get("splats")
        pipeline: Any = content.get("pipeline")
        if isinstance(splats, Mapping):
            return splats, _GSPLAT
        for prefix in _PREFIXES if isinstance(pipeline, Mapping) else ():
            if f"{prefix}means" in pipeline:
                named = {name[len(prefix) :]: tensor for name, tensor in pipeline.items() if name.startswith(prefix)}
                return named, _SPLATFACTO
    found = ", ".join(map(str, content)) if isinstance(content, Mapping) else type(content).__name__
    raise UnfitError(f"holds {quoted(found)}; expected 'splats' (gsplat) or 'pipeline' (splatfacto)")


def _array(tensors: Mapping[str, Any], name: str, most: int) -> npt.NDArray[np.float32]:
    """Take a tensor as an array; `UnfitError` where strides make it larger than the file, of `most` bytes."""
    import torch

    tensor = tensors.get(name)
    if not isinstance(tensor, torch.Tensor) or tensor.layout != torch.strided or not tensor.is_floating_point():
        raise UnfitError(f"has no tensor of numbers {name!r}; expected means, scales, quats, opacities and SH")
    if tensor.numel() * tensor.element_size() > most:
        raise UnfitError(f"{name} is of shape {tuple(tensor.shape)}, more than the file holds")
    return np.array(tensor.detach().float().numpy())


def _vertices(
    arrays: dict[str, npt.NDArray[np.float32]],
    dc: npt.NDArray[np.float32],  # (N, 1, 3) or (N, 3)
    rest: npt.NDArray[np.float32],  # (N, B, 3)
    splatfacto: bool,
) -> npt.NDArray[np.void]:
    n, bands = len(arrays["means"]), (MAX_DEGREE + 1) ** 2 - 1
    degrees = [(d + 1) ** 2 - 1 for d in range(5)]
    shapes = {"means": (n, 3), "scales": (n, 3), "quats": (n, 4)}
    wrong = [name for name, shape in shapes.items() if arrays[name].shape != shape]
    if arrays["opacities"].size != n or dc.size != 3 * n or rest.ndim != 3 or rest.shape[1] not in degrees:
        wrong.append("opacities or SH")
    if wrong or len(rest) != n or rest.shape[2] != 3:
        raise UnfitError(f"has {', '.join(wrong) or 'SH'} of a shape that does not fit {n:,} Gaussians")
    dc = dc.reshape(n, 3)
    if splatfacto and rest.shape[1] == 0:  # Trained without SH, it learns logits of colours.
        dc = dc_of(1 / (1 + np.exp(-dc.astype(np.float64)))).astype(np.float32)
    return pack_vertices(
        arrays["means"], arrays["quats"], arrays["scales"], arrays["opacities"].reshape(n), dc, rest[:, :bands]
    )
