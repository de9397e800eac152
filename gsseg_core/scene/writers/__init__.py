"""Gaussians as files of other formats than PLY, one module each; `gsseg_core.scene.scene_writers` has the table."""
