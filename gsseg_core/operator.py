"""A posed view as a linear operator: the weight matrix W (pixels x Gaussians) and its transpose."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from gsseg_core import products
from gsseg_core.cameras import Camera
from gsseg_core.projection import project
from gsseg_core.scene import GaussianScene
from gsseg_core.tiles import TILE, assign


class ViewOperator:
    def __init__(self, scene, camera):
        self.camera = camera
        self.num_gaussians = len(scene)
        self._projected = project(scene, camera)
        self._tiles = assign(self._projected, camera.width, camera.height)

    @property
    def ids(self):
        return self._projected.ids

    def render(self, codes):
        codes = np.ascontiguousarray(codes[self.ids], np.float32)
        t = self._tiles
        out = np.empty((self.camera.height, self.camera.width, codes.shape[1]), np.float32)
        left = np.empty(out.shape[:2], np.float32)
        products.render(t.columns, self._projected.table, t.start, t.entries, codes, out, left)
        return out, left

    def adjoint(self, residual):
        t = self._tiles
        out = np.zeros((self.num_gaussians, residual.shape[2]), np.float32)
        rows = np.empty((len(self.ids), products.CHUNK), np.float32)
        for k in range(0, residual.shape[2], products.CHUNK):
            part = np.ascontiguousarray(residual[..., k:k + products.CHUNK], np.float32)
            sums = np.empty((len(t.entries), part.shape[2]), np.float32)
            products.adjoint_entries(t.columns, self._projected.table, t.start, t.entries, part, sums)
            rows = np.empty((len(self.ids), part.shape[2]), np.float32)
            products.reduce_entries(t.gaussian_start, t.gaussian_entries, sums, rows)
            out[self.ids, k:k + products.CHUNK] = rows
        return out

    def prepare(self, labels, num):
        t = self._tiles
        ls, present, slots = products.tile_labels(labels, t.columns, t.rows, num)
        per = np.diff(t.start)
        ss = np.concatenate([[0], np.cumsum(per * np.diff(ls))])
        et = np.repeat(np.arange(len(per), dtype=np.int32), per)
        return ls, present, slots, ss, et

    def lift(self, prep, codes, rest, divide):
        t = self._tiles
        ls, present, slots, ss, et = prep
        lik = np.empty((len(t.start) - 1, TILE, TILE), np.float32)
        left = np.empty_like(lik)
        sums = np.empty(ss[-1], np.float32)
        products.labelled(t.columns, self.camera.width, self.camera.height, self._projected.table, t.start, t.entries, ls, present, slots, codes, rest, divide, ss, lik, left, sums)
        out = np.empty(codes.shape, np.float32)
        products.reduce_labelled(t.start, t.gaussian_start, t.gaussian_entries, et, ls, present, ss, sums, out)
        return out, lik, left
