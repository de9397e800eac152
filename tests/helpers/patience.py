"""How long tests wait for what must come: far longer than it ever takes, so that a busy machine fails none of them."""

from __future__ import annotations

PATIENCE = 300.0
"""Seconds until a wait gives up."""
