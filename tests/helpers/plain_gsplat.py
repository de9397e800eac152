"""The functions of gsplat 1.5.3 that gsseg calls, in plain PyTorch: what they promise, as their documentation has it.

It stands in for gsplat where there is no GPU, so that all around the kernels is tested. Like them, it works in float32,
leaves rubbish where nothing is visible, lets alpha rise to 0.999, and ends a ray before the Gaussian that would bring
its transmittance to 1e-4. Only colours have a gradient.
"""

from __future__ import annotations

from typing import Any

import torch

INT_MAX = 2.0**31 - 128  # the largest float32 that fits


@torch.no_grad()
def fully_fused_projection(
    means: torch.Tensor,  # (N, 3)
    covars: None,
    quats: torch.Tensor,  # (N, 4)
    scales: torch.Tensor,  # (N, 3)
    viewmats: torch.Tensor,  # (1, 4, 4)
    Ks: torch.Tensor,  # (1, 3, 3)
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    packed: bool = False,
    sparse_grad: bool = False,
    calc_compensations: bool = False,
    camera_model: str = "pinhole",
    opacities: torch.Tensor | None = None,  # (N,)
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, None]:
    """Radii (1, N, 2) int32, means (1, N, 2), depths (1, N), conics (1, N, 3)."""
    n = len(means)
    assert opacities is not None and covars is None and not (packed or sparse_grad or calc_compensations)
    expect(means, n, 3), expect(quats, n, 4), expect(scales, n, 3), expect(opacities, n)
    expect(viewmats, 1, 4, 4), expect(Ks, 1, 3, 3)
    view, K = viewmats[0], Ks[0]
    centres = means @ view[:3, :3].T + view[:3, 3]
    depth = centres[:, 2]

    focal, middle, size = K.diagonal()[:2], K[:2, 2], torch.tensor([width, height])
    slope = centres[:, :2] / depth[:, None]
    margin = 0.15 * size / focal
    near_image = torch.clamp(slope, -middle / focal - margin, (size - middle) / focal + margin)
    jacobian = torch.zeros((n, 2, 3))
    jacobian[:, [0, 1], [0, 1]] = focal / depth[:, None]
    jacobian[:, :, 2] = -focal * near_image / depth[:, None]
    axes = rotations(quats) * scales[:, None]
    spread = jacobian @ view[:3, :3] @ axes
    covariance = spread @ spread.mT + eps2d * torch.eye(2)
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    determinant = xx * yy - xy * xy
    conics = torch.stack([yy, -xy, xx], dim=1) / determinant[:, None]

    means2d = slope * focal + middle
    reach = torch.sqrt(2 * torch.log(opacities * 255)).nan_to_num().clamp(max=3.33)
    radii = torch.ceil(reach[:, None] * torch.stack([xx, yy], dim=1).sqrt())
    visible = (depth >= near_plane) & (depth <= far_plane) & (opacities >= 1 / 255) & (radii > radius_clip).any(dim=1)
    visible &= ~(determinant <= 0) & ((means2d + radii > 0) & (means2d - radii < size)).all(dim=1)
    whole = torch.where(visible[:, None], radii.clamp(max=INT_MAX), 0).to(torch.int32)
    rubbish = torch.full((), float("nan"))
    return (
        whole[None],
        torch.where(visible[:, None], means2d, rubbish)[None],
        torch.where(visible, depth, rubbish)[None],
        torch.where(visible[:, None], conics, rubbish)[None],
        None,
    )


def rotations(quats: torch.Tensor) -> torch.Tensor:
    """Matrices (N, 3, 3) of quaternions w, x, y, z: v -> v + 2 w (q x v) + 2 q x (q x v)."""
    quats = quats / quats.norm(dim=1, keepdim=True)
    cross = torch.zeros((len(quats), 3, 3))
    for axis in range(3):
        unit = torch.zeros(3)
        unit[axis] = 1
        cross[:, :, axis] = torch.linalg.cross(quats[:, 1:], unit.expand(len(quats), 3))
    return torch.eye(3) + 2 * quats[:, :1, None] * cross + 2 * cross @ cross


@torch.no_grad()
def isect_tiles(
    means2d: torch.Tensor,  # (1, M, 2)
    radii: torch.Tensor,  # (1, M, 2) int32
    depths: torch.Tensor,  # (1, M)
    tile_size: int,
    tile_width: int,
    tile_height: int,
    sort: bool = True,
    segmented: bool = False,
    packed: bool = False,
    n_images: int | None = None,
    image_ids: torch.Tensor | None = None,
    gaussian_ids: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Tiles per Gaussian (1, M) int32, then of all pairs the key (tile, depth) int64 and the Gaussian int32."""
    m = means2d.shape[1]
    assert sort and not (segmented or packed)
    expect(means2d, 1, m, 2), expect(depths, 1, m), expect(radii, 1, m, 2, dtype=torch.int32)
    grid = torch.tensor([tile_width, tile_height])
    low = torch.floor((means2d[0] - radii[0]) / tile_size).clamp(min=0).minimum(grid).long()
    high = torch.ceil((means2d[0] + radii[0]) / tile_size).clamp(min=0).minimum(grid).long()
    bits = depths[0].view(torch.int32).tolist()
    counts, keys, entries = [], [], []
    for g, ((left, top), (right, bottom)) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
        tiles = [row * tile_width + column for row in range(top, bottom) for column in range(left, right)]
        counts.append(len(tiles))
        keys += [tile << 32 | bits[g] for tile in tiles]
        entries += [g] * len(tiles)
    order = torch.argsort(torch.tensor(keys, dtype=torch.int64), stable=True)
    return (
        torch.tensor(counts, dtype=torch.int32)[None],
        torch.tensor(keys, dtype=torch.int64)[order],
        torch.tensor(entries, dtype=torch.int32)[order],
    )


@torch.no_grad()
def isect_offset_encode(isect_ids: torch.Tensor, n_images: int, tile_width: int, tile_height: int) -> torch.Tensor:
    """Where each tile's pairs begin, (1, tile_height, tile_width) int32."""
    assert n_images == 1 and isect_ids.dtype == torch.int64
    tiles = torch.arange(tile_width * tile_height)
    return torch.searchsorted(isect_ids >> 32, tiles).to(torch.int32).view(1, tile_height, tile_width)


def rasterize_to_pixels(
    means2d: torch.Tensor,  # (1, M, 2)
    conics: torch.Tensor,  # (1, M, 3)
    colors: torch.Tensor,  # (1, M, C)
    opacities: torch.Tensor,  # (1, M)
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: torch.Tensor,  # (1, tile_height, tile_width) int32
    flatten_ids: torch.Tensor,  # (E,) int32
    backgrounds: torch.Tensor | None = None,
    masks: torch.Tensor | None = None,
    packed: bool = False,
    absgrad: bool = False,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Colours (1, H, W, C) and opacity (1, H, W, 1)."""
    m, channels = colors.shape[1:]
    assert m > 0 and 1 <= channels <= 513 and backgrounds is None and masks is None and not (packed or absgrad)
    expect(means2d, 1, m, 2), expect(conics, 1, m, 3), expect(colors, 1, m, channels), expect(opacities, 1, m)
    lines, columns = isect_offsets.shape[1:]
    expect(isect_offsets, 1, lines, columns, dtype=torch.int32)
    expect(flatten_ids, len(flatten_ids), dtype=torch.int32)
    assert lines * tile_size >= image_height and columns * tile_size >= image_width

    begins = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
    pixels, parts, left_over = [], [], []
    for tile in range(lines * columns):
        top, left = tile // columns * tile_size, tile % columns * tile_size
        row = torch.arange(top, min(top + tile_size, image_height))
        column = torch.arange(left, min(left + tile_size, image_width))
        r, c = torch.meshgrid(row, column, indexing="ij")
        entries = flatten_ids[begins[tile] : begins[tile + 1]].long()
        centres = torch.stack([c.flatten(), r.flatten()], dim=1) + 0.5
        weights, rays = blend(means2d[0, entries], conics[0, entries], opacities[0, entries], centres)
        pixels.append((r * image_width + c).flatten())
        parts.append(weights @ colors[0, entries])
        left_over.append(rays)
    place = torch.argsort(torch.cat(pixels))
    image, rays = torch.cat(parts)[place], torch.cat(left_over)[place]
    return image.view(1, image_height, image_width, channels), 1 - rays.view(1, image_height, image_width, 1)


@torch.no_grad()
def blend(
    means2d: torch.Tensor,  # (E, 2), nearest first
    conics: torch.Tensor,  # (E, 3)
    opacities: torch.Tensor,  # (E,)
    pixels: torch.Tensor,  # (P, 2)
) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights (P, E), and what each ray has left over (P,)."""
    x, y = (means2d[None] - pixels[:, None]).unbind(dim=2)
    sigma = 0.5 * (conics[:, 0] * x**2 + conics[:, 2] * y**2) + conics[:, 1] * x * y
    alphas = (opacities * torch.exp(-sigma)).clamp(max=0.999)
    alphas = torch.where((sigma < 0) | (alphas < 1 / 255), 0, alphas)
    rays = torch.cumprod(torch.cat([torch.ones((len(pixels), 1)), 1 - alphas], dim=1), dim=1)
    going_on = rays > 1e-4
    return alphas * rays[:, :-1] * going_on[:, 1:], torch.where(going_on, rays, 1).amin(dim=1)


def expect(tensor: torch.Tensor, *shape: int, dtype: Any = torch.float32) -> None:
    """What the CUDA code would refuse, or read as something else."""
    assert tensor.shape == shape and tensor.dtype == dtype, (tensor.shape, tensor.dtype, shape)
