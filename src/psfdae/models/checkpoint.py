"""State of an interrupted training, kept until its result is safe."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from psfdae.files import atomic_path

MAGIC = b"psfdae checkpoint, sha256 "
"""What the file starts with; the checksum of all that follows it comes next."""


def save_checkpoint(path: Path, fingerprint: str, state: Mapping[str, Any]) -> None:
    """Write tensors and plain values with their checksum and the hash of what the training sees."""
    content = io.BytesIO()
    torch.save({"fingerprint": fingerprint, **state}, content)
    digest = hashlib.sha256(content.getbuffer()).hexdigest().encode()
    # No product: it changes all the time, and guards itself.
    with atomic_path(path, digest=False) as temporary, temporary.open("wb") as file:
        file.write(MAGIC + digest + b"\n")
        file.write(content.getbuffer())


def load_checkpoint(path: Path, fingerprint: str) -> dict[str, Any] | None:
    """The state of an interrupted training of the same configuration, if there is one.

    Parameters
    ----------
    path : Path
    fingerprint : str
        A checkpoint with another one is ignored with a line printed, as is a damaged file.

    Returns
    -------
    dict or None
        As saved; its `history` has one row per epoch.
    """
    if not path.is_file():
        return None
    head, _, content = path.read_bytes().partition(b"\n")
    if head != MAGIC + hashlib.sha256(content).hexdigest().encode():
        print(f"{path}: damaged checkpoint ignored (wrong checksum)", flush=True)
        return None
    try:
        state: dict[str, Any] = torch.load(io.BytesIO(content), weights_only=True)
    except Exception as error:  # written by another version of torch
        print(f"{path}: unreadable checkpoint ignored ({type(error).__name__})", flush=True)
        return None
    if state.pop("fingerprint", None) != fingerprint:
        print(f"{path}: checkpoint of another configuration ignored", flush=True)
        return None
    print(f"{path}: resuming after epoch {len(state['history'])}", flush=True)
    return state
