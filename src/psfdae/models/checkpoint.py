"""State of an interrupted training, kept until its result is safe."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from psfdae.files import atomic_path


def save_checkpoint(path: Path, fingerprint: str, state: Mapping[str, Any]) -> None:
    """Write tensors and plain values, with the hash of what the training sees."""
    with atomic_path(path) as temporary:
        torch.save({"fingerprint": fingerprint, **state}, temporary)


def load_checkpoint(path: Path, fingerprint: str) -> dict[str, Any] | None:
    """The state of an interrupted training of the same configuration, if there is one.

    Parameters
    ----------
    path : Path
    fingerprint : str
        A checkpoint with another one is ignored, as is a damaged file.

    Returns
    -------
    dict or None
        As saved; its `history` has one row per epoch.
    """
    if not path.is_file():
        return None
    try:
        state: dict[str, Any] = torch.load(path, weights_only=True)
    except Exception as error:  # any damage means the same: start afresh
        print(f"{path}: unreadable checkpoint ignored ({error})", flush=True)
        return None
    if state.pop("fingerprint", None) != fingerprint:
        print(f"{path}: checkpoint of another configuration ignored", flush=True)
        return None
    print(f"{path}: resuming after epoch {len(state['history'])}", flush=True)
    return state
