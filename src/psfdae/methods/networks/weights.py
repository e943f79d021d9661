"""Files of a network with checksums: its weights, and the state of an interrupted training."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from psfdae.base.errors import no_such_file, require_file
from psfdae.base.files import ProductError, atomic_path
from psfdae.base.types import Module, Tensor

Network = TypeVar("Network", bound="Module")

METADATA_KEY = "psfdae"
"""Only key of the metadata of a file of weights: safetensors writes several keys in random
order."""

CHECKPOINT_HEADER = b"psfdae checkpoint, sha256 "
"""First bytes of a checkpoint; the checksum of the content and a line feed follow."""


def compute_digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of the names, types, shapes and values of arrays, sorted by name."""
    # Names, types and shapes are included, because equal bytes may belong to another network.
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
    path : Path
        The safetensors file, which is replaced atomically.
    state : mapping of str to torch.Tensor
        Tensors by name.
    config : mapping
        Settings that decide the weights, as JSON can hold them.
    """
    from safetensors.numpy import save

    arrays = {name: np.array(tensor.numpy(), order="C") for name, tensor in state.items()}
    # The checksum of the arrays does not depend on the header of the file.
    metadata = json.dumps({"config": config, "sha256": compute_digest(arrays)})
    with atomic_path(path) as temporary:
        # The file function of safetensors itself does not set the usual permissions.
        temporary.write_bytes(save(arrays, {METADATA_KEY: metadata}))


def load_network(build: Callable[[], Network], path: Path) -> Network:
    """Return a network with weights from a file, ready to predict.

    Parameters
    ----------
    build : callable
        Function that makes the network that the file's configuration describes.
    path : Path
        File of the weights.

    Raises
    ------
    ProductError
        As `load_weights`, or if the tensors do not agree with the network.
    """
    import torch

    state = {name: torch.from_numpy(array) for name, array in load_weights(path).items()}
    # On the device "meta", a network has shapes but takes no memory: a wrong size in the
    # configuration is an error before it fills the memory.
    try:
        with torch.device("meta"):
            needed_shapes = {name: value.shape for name, value in build().state_dict().items()}
    except (RuntimeError, ValueError, TypeError, OverflowError) as error:
        line = " ".join(str(error).split())
        raise ProductError(f"{path}: its config.yaml describes no network ({line})") from None
    # A tensor may be missing, unexpected, or of another shape.
    for name in sorted(needed_shapes.keys() | state.keys()):
        shape = tuple(state[name].shape) if name in state else "none"
        needed_shape = tuple(needed_shapes[name]) if name in needed_shapes else "none"
        if shape != needed_shape:
            raise ProductError(
                f"{path}: shape of {name} is {shape}, but {needed_shape} in the network of its "
                "config.yaml"
            )
    # The shapes agree: make the network itself.
    model = channels_last(build())
    model.load_state_dict(state)
    return model.eval()


def channels_last(network: Network) -> Network:
    """Return the network with weights in the order in memory that makes convolutions fastest."""
    import torch

    # The types of torch have this argument only for tensors.
    network_in_order: Network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network_in_order


def load_weights(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a network by name.

    Raises
    ------
    ProductError
        If the file is missing, not a safetensors file, or has changed since it was written.
    """
    from safetensors import SafetensorError, safe_open

    require_file(path)
    try:
        with safe_open(path, "numpy") as file:
            metadata = dict(json.loads((file.metadata() or {}).get(METADATA_KEY, "{}")))
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise ProductError(no_such_file(path)) from None
    except (SafetensorError, OSError, ValueError, TypeError, RecursionError) as error:
        raise ProductError(f"{path}: damaged ({error}); delete it and run again") from error
    # Weights of another program have no checksum to compare.
    if metadata.get("sha256", compute_digest(arrays)) != compute_digest(arrays):
        raise ProductError(f"{path}: damaged (wrong checksum); delete it and run again")
    return arrays


def save_checkpoint(path: Path, fingerprint: str, state: Mapping[str, Any]) -> None:
    """Write the state of a training with its checksum and the hash of settings and data.

    Parameters
    ----------
    path : Path
        The checkpoint, which is replaced atomically.
    fingerprint : str
        Hash of the settings and the data of the training.
    state : mapping
        Tensors and plain values by name.
    """
    import torch

    # In memory first, because the checksum precedes the content.
    content = io.BytesIO()
    torch.save({"fingerprint": fingerprint, **state}, content)
    digest = hashlib.sha256(content.getbuffer()).hexdigest().encode()
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(CHECKPOINT_HEADER + digest + b"\n")
        file.write(content.getbuffer())


def load_checkpoint(path: Path, fingerprint: str) -> dict[str, Any] | None:
    """Return the state of an interrupted training, or None.

    A checkpoint that is damaged, or of other settings or data, is ignored with a printed line.
    """
    import torch

    if not path.is_file():
        return None
    # A checkpoint only saves time: if anything is wrong with it, the training begins anew.
    head, _, content = path.read_bytes().partition(b"\n")
    if head != CHECKPOINT_HEADER + hashlib.sha256(content).hexdigest().encode():
        print(f"{path}: damaged checkpoint ignored (wrong checksum)", flush=True)
        return None
    # weights_only, so that a file cannot run code.
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
