"""Files of a network that notice damage: its weights, and an interrupted training's state."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from psfdae.files import ProductError, atomic_path

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

Network = TypeVar("Network", bound="Module")

ABOUT = "psfdae"
"""The one key of the metadata: safetensors would write several in random order."""

MAGIC = b"psfdae checkpoint, sha256 "
"""First bytes of a checkpoint; the checksum of all that follows it comes next."""


def digest_of(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of names, types, shapes and values of arrays, in the order of the names."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        values = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def save_weights(path: Path, state: Mapping[str, Tensor], config: Mapping[str, Any]) -> None:
    """Write a network's tensors, its resolved config and the checksum of the tensors.

    Parameters
    ----------
    path : path of the safetensors file; replaced atomically
    state : mapping of name to torch.Tensor
    config : mapping that JSON can hold
    """
    from safetensors.numpy import save

    arrays = {name: np.array(tensor.numpy(), order="C") for name, tensor in state.items()}
    about = json.dumps({"config": config, "sha256": digest_of(arrays)})
    with atomic_path(path) as temporary:
        # Written by us, so that the file gets the usual permissions.
        temporary.write_bytes(save(arrays, {ABOUT: about}))


def with_weights(build: Callable[[], Network], path: Path) -> Network:
    """A network with weights from a file, ready to predict.

    Parameters
    ----------
    build : callable
        Makes the network that the file's configuration describes.
    path : Path

    Raises
    ------
    ProductError
        As `load_weights`, and if the tensors are not those of the network. That is
        found before the network is made, so that a wrong size does not fill the memory.
    """
    import torch

    state = {name: torch.from_numpy(array) for name, array in load_weights(path).items()}
    try:
        with torch.device("meta"):
            wanted = {name: value.shape for name, value in build().state_dict().items()}
    except (RuntimeError, ValueError, TypeError, OverflowError) as error:
        line = " ".join(str(error).split())
        raise ProductError(f"{path}: its config.yaml describes no network ({line})") from None
    found = {name: value.shape for name, value in state.items()}
    for name in sorted(wanted.keys() | found.keys()):
        if wanted.get(name) != found.get(name):
            has, needs = (
                f"{tuple(each[name])}" if name in each else "none" for each in (found, wanted)
            )
            raise ProductError(
                f"{path}: shape of {name} is {has}, but {needs} in the network of its config.yaml"
            )
    model = channels_last(build())
    model.load_state_dict(state)
    return model.eval()


def channels_last(network: Network) -> Network:
    """The network with its weights in the order in memory in which convolutions are fastest."""
    import torch

    # torch's own types know this argument of tensors only.
    moved: Network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return moved


def load_weights(path: Path) -> dict[str, np.ndarray]:
    """Arrays of a network by name.

    Raises
    ------
    ProductError
        If the file is missing, not a safetensors file, or not what was written.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "numpy") as file:
            about = dict(json.loads((file.metadata() or {}).get(ABOUT, "{}")))
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise ProductError(f"{path}: no such file") from None
    except (SafetensorError, OSError, ValueError, TypeError, RecursionError) as error:
        raise ProductError(f"{path}: damaged ({error}); delete it and run again") from error
    # Weights of another program have no checksum, and nothing to compare with.
    if about.get("sha256", digest_of(arrays)) != digest_of(arrays):
        raise ProductError(f"{path}: damaged (wrong checksum); delete it and run again")
    return arrays


def save_checkpoint(path: Path, fingerprint: str, state: Mapping[str, Any]) -> None:
    """Write tensors and plain values with their checksum and the hash of what the training sees."""
    import torch

    content = io.BytesIO()
    torch.save({"fingerprint": fingerprint, **state}, content)
    digest = hashlib.sha256(content.getbuffer()).hexdigest().encode()
    # No product: it changes all the time, and guards itself.
    with atomic_path(path, digest=False) as temporary, temporary.open("wb") as file:
        file.write(MAGIC + digest + b"\n")
        file.write(content.getbuffer())


def load_checkpoint(path: Path, fingerprint: str) -> dict[str, Any] | None:
    """The state of an interrupted training; a damaged or another one is ignored, and named."""
    import torch

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
