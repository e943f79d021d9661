"""Files as an enemy would write them, handed to the command line one by one.

    python tests/hostile_files.py 10000 [SEED] [FOLDER]

makes so many inputs from good ones, by seeded mutation, and runs `psfdae` on each in
a process of its own, forked from one that has imported everything. What must hold: exit
code 0, or 2 with one line; no more than 1 GB of data, no more than 20 s. Inputs
that break it are kept in FOLDER.

    python tests/hostile_files.py own 1000 [SEED] [FOLDER]

takes inputs of `from-stars`, mosaics, lists, `psf` and field models, and looks at what comes out,
too: a star or PSF without a flag is finite, positive, in the middle, has its flux, and χ² < 10.
Of what it has looked at it counts the files, and the stars and PSFs without a flag (`judged`).
"""

from __future__ import annotations

import bz2
import contextlib
import gzip
import io
import json
import lzma
import os
import random
import re
import resource
import shutil
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

BYTES, SECONDS = 2**30, 40

LARGEST = 2**24
"""Bytes by which a line is repeated at most; an input must not fill our own memory."""


def words(text):
    return text.split()


NUMBERS = words("""-1 0 1 2 7 9 255 999 65536 2147483647 4294967296 9223372036854775807 -32 -64
1e308 99999999999999999999 1e-320 0.1 nan inf T F '' 'X' 'PB(9)' '1QD' '9999999J' 'RICE_1' 'GZIP_2'
'NONE' 'RA---TAN-SIP' 'RA---TAB' '-TPV' '''' (1,2)""")

KEYS = words("""NAXIS NAXIS1 NAXIS2 NAXIS3 NAXIS4 BITPIX PCOUNT GCOUNT TFIELDS THEAP TFORM1 TFORM2
TDIM1 TNULL1 TZERO1 TSCAL1 TTYPE1 ZNAXIS1 ZNAXIS2 ZNAXIS3 ZNAXIS ZTILE1 ZTILE2 ZTILE3 ZBITPIX
ZVAL1 ZVAL2 ZNAME1 ZCMPTYPE ZQUANTIZ ZDITHER0 ZBLANK ZSCALE ZZERO BSCALE BZERO BLANK WCSAXES A_ORDER
BP_ORDER CTYPE1 CRPIX1 CRPIX99 CD1_1 CDELT1 CUNIT1 PV1_1 LONPOLE GAIN SATURATE PIXSCALE EXTNAME
EXTVER GROUPS SIMPLE XTENSION EXTEND CONTINUE INHERIT OBJECT BUNIT HIERARCH CPDIS1 DP1 END""")

CELLS = ["", *words("""nan inf -1e400 1e308 =1+1 1h " ' 10:20:30 ² ٣ 1,2 ; # -- 0x10 1_0 True""")]
CELLS += ["9" * 400, "x" * 300, "x" * 50_000, "\x1b[31m", "\ud800"]

VALUES = [None, True, -1, 0, 1, 2, 3, 8, 64, 128, 256, 1000, 2**31, 2**63, 10**30, 1e-300, 1e300]
VALUES += [0.5, "", "x", "\x1b[2J", "x" * 10_000, [], [1], {}, {"a": 1}]


def deep(depth):
    """A list in a list in a list …"""
    found = 1
    for _ in range(depth):
        found = [found]
    return found


# Good files.


def write_good(folder):
    """Cubes, images, catalogues, a bundle and weights, as `GOOD` lists them."""
    from astropy.io import fits
    from astropy.table import Table

    from fits_inputs import write_cube, write_field
    from prediction_stars import with_network
    from psfdae.model.bundle import read_bundle, shipped_path, write_bundle
    from psfdae.networks.weights import save_weights

    rng = np.random.default_rng(1)
    grid = np.arange(16) - 8
    star = np.exp(-(grid[:, None] ** 2 + grid**2) / 8.0)
    stamps = rng.poisson(100 + 400 * star, (12, 16, 16)).astype(float)
    x, y = rng.uniform(0, 60, 12), rng.uniform(0, 40, 12)
    write_cube(folder / "cube.fits", stamps, PIXSCALE=0.1)
    write_cube(folder / "cube16.fits", stamps.astype(np.uint16), PIXSCALE=0.1)
    write_cube(folder / "cube.fz", stamps, compress=True, PIXSCALE=0.1)
    for name, compress in (("image.fits", False), ("image.fz", True)):
        write_field(
            *(folder / name, folder / "s.csv", 400 * stamps / 500, x, y),
            shape=(40, 60), pixel_scale_arcsec=0.1, compress=compress,
        )  # fmt: skip
    raw = (folder / "cube.fits").read_bytes()
    for pack, packed in PACK.items():
        (folder / f"cube.{pack}").write_bytes(packed(raw))
    for coding in ("GZIP_1", "GZIP_2"):
        tiles = fits.CompImageHDU(rng.poisson(9, (40, 60)), compression_type=coding)
        fits.HDUList([fits.PrimaryHDU(), tiles]).writeto(folder / f"{coding}.fz")
    table = Table.read(folder / "s.csv")
    table["name"] = [f"star {k}" for k in range(12)]
    table["ra", "dec"].write(folder / "sky.csv")
    table.write(folder / "s.fits")
    table.write(folder / "s.ecsv")
    lines = [f"# {k + 1} {name}" for k, name in enumerate(("NUMBER", "X_IMAGE", "Y_IMAGE"))]
    lines += [f"{row['id']} {row['X_IMAGE']} {row['Y_IMAGE']}" for row in table]
    (folder / "s.cat").write_text("\n".join(lines))
    shutil.copy(shipped_path(), folder / "mixture.psf.safetensors")
    write_bundle(with_network(read_bundle()), folder / "network.psf.safetensors")
    save_weights(
        folder / "dae.safetensors",
        {"layers.0.weight": Tensor(rng.normal(size=(1, 1, 3, 3)).astype(np.float32))},
        {"dae": {"kernels": [3, 3], "widths": [1]}},
    )


@dataclass(frozen=True)
class Tensor:
    """Looks like one of torch."""

    array: np.ndarray

    def numpy(self):
        return self.array


def _zip(raw):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("a.fits", raw)
    return out.getvalue()


PACK = {
    "gz": lambda raw: gzip.compress(raw, 1),
    "bz2": bz2.compress,
    "xz": lzma.compress,
    "zip": _zip,
}

GOOD = {
    "cube": ["cube.fits", "cube16.fits", "cube.fz", *(f"cube.{pack}" for pack in PACK)],
    "image": ["image.fits", "image.fz", "GZIP_1.fz", "GZIP_2.fz"],
    "catalogue": ["s.csv", "s.fits", "s.ecsv", "s.cat"],
    "bundle": ["network.psf.safetensors", "mixture.psf.safetensors"],
    "weights": ["dae.safetensors"],
}

# Mutations: bytes to bytes.


def any_bytes(raw, rng):
    """Bytes changed, lost, inserted, repeated, or cut off."""
    raw = bytearray(raw)
    for _ in range(rng.choice([1, 1, 2, 5, 20])):
        place = rng.randrange(min(len(raw), rng.choice([100, 3000, 9000, 10**9])) or 1)
        what = rng.randrange(6)
        if what <= 1 and raw:
            raw[place] = rng.choice([0, 255, 32, 48, 57, rng.randrange(256)])
        elif what == 2:
            del raw[place : place + rng.choice([1, 80, 2880, 10_000])]
        elif what == 3:
            raw[place:place] = rng.randbytes(rng.choice([1, 8, 80]))
        elif what == 4:
            piece = raw[place : place + rng.choice([80, 2880])]
            raw[place:place] = piece * rng.choice([1, 10, 300])
        else:
            del raw[rng.randrange(len(raw) + 1) :]
    return bytes(raw)


def cards(raw, rng):
    """Header cards with other values, keys or places."""
    raw = bytearray(raw)
    starts = [m.start() for m in re.finditer(rb"(SIMPLE  =|XTENSION=)", raw) if m.start() % 80 == 0]
    for _ in range(rng.choice([1, 1, 2, 4])):
        start = rng.choice(starts or [0])
        end = raw.find(b"END" + b" " * 77, start)
        count = max((end - start) // 80, 1)
        place = start + 80 * rng.randrange(count + 1)
        key = rng.choice(KEYS) if rng.random() < 0.5 else raw[place : place + 8].decode("latin-1")
        if rng.random() < 0.6:
            # The card of that key, if there is one.
            found = raw.find(key.ljust(8).encode("latin-1") + b"=", start, max(end, start))
            place = found if found >= 0 else place
        card = f"{key:<8}= {rng.choice(NUMBERS):>20}".encode("latin-1")[:80].ljust(80)
        if rng.random() < 0.2:
            raw[place:place] = card + b" " * 0
            del raw[end : end + 80]
        else:
            raw[place : place + 80] = card
    return bytes(raw)


def cells(raw, rng):
    """Cells, names and lines of a text table."""
    lines = raw.decode("utf-8", "surrogatepass").split("\n")
    for _ in range(rng.choice([1, 2, 5])):
        row = rng.choice([0, rng.randrange(len(lines))])
        parts = re.split(r"([,;\t ])", lines[row])
        parts[rng.randrange(len(parts))] = rng.choice(CELLS)
        lines[row] = "".join(parts)
        what = rng.randrange(12)
        if what == 0:
            most = LARGEST // (len(lines[row]) + 1)
            lines[row:row] = [lines[row]] * min(rng.choice([1, 1000, 50_000]), most)
        elif what == 1:
            lines[row] = lines[row] + "," + ",".join(["a"] * rng.choice([1, 3000, 200_000]))
        elif what == 2:
            lines[row] = f"# {rng.choice([0, 9, 10**6, 10**9])} {rng.choice('XYZ')}"
        elif what == 3:
            lines[row] = "# " + rng.choice("[{&*!-") * rng.choice([1, 1000, 50_000])
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def tensors(raw, rng, sign, changed=None):
    """A safetensors file with another description or other arrays, signed anew."""
    changed = changed or another
    from safetensors.numpy import load, save

    size = struct.unpack("<Q", raw[:8])[0]
    ((key, text),) = json.loads(raw[8 : 8 + size])["__metadata__"].items()
    text, arrays = json.loads(text), dict(load(raw))
    changes = rng.choice([1, 1, 2, 3])
    if "dae" in text.get("info", {}) and rng.random() < 0.25:
        text["info"], arrays = another_size(text["info"], arrays, rng)
        changes = rng.choice([0, 0, 1])
    for _ in range(changes):
        if changed is another and rng.random() < 0.5:
            node = text.get("info", text)
            while True:
                name = rng.choice(list(node))
                inner = node[name]
                if not (isinstance(inner, dict) and inner) or rng.random() < 0.3:
                    break
                node = inner
            value = rng.choice([*VALUES, deep(rng.choice([50, 900, 5000]))])
            if isinstance(inner, list) and inner and rng.random() < 0.7:
                inner[rng.randrange(len(inner))] = value
            else:
                node[rng.choice([name, name, name, "\x1b[31mnew"])] = value
        else:
            name = rng.choice(list(arrays))
            with np.errstate(all="ignore"), contextlib.suppress(OverflowError):
                arrays[name] = changed(arrays[name], rng)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            signed = sign(text, arrays) if rng.random() < 0.95 else text
            return save(arrays, {key: json.dumps(signed)})
        except (RecursionError, ValueError):
            nested = "[" * 100_000
            return save(arrays, {key: f'{{"kind": "psfdae bundle", "info": {nested}'})


def another_size(info, arrays, rng):
    """A bundle whose parts fit together, of any size and of no sense."""
    side, kept = rng.choice([8, 16, 40, 64, 128, 256, 512]), rng.choice([1, 7, 48, 64, 200])
    # Small networks: a large one takes the time that it takes.
    layers = rng.choice([2, 3, 10] if side < 64 else [2, 3])
    kernels = [rng.choice([1, 3, 31] if side < 64 else [1, 3, 5]) for _ in range(layers)]
    kernels[0] += rng.random() < 0.1
    widths = [rng.choice([1, 2, 3]) for _ in range(layers - 1)]
    numbers = np.random.default_rng(rng.randrange(1000))
    basis = numbers.normal(size=(side**2, kept))
    basis = np.linalg.qr(basis)[0] if rng.random() < 0.7 and kept <= side**2 else 0 * basis
    mean = numbers.random(side**2) * rng.choice([0, 1, 1, 1])
    maps = np.ones((len(arrays["noise_nodes"]), side, side))
    flux = {"mean": mean / (mean.sum() or 1), "low": 0 * mean, "high": 0 * mean + 1, "basis": basis}
    made = {f"flux/{name}": values for name, values in flux.items()}
    made |= {"error68": maps, "rms": maps}
    channels = [1, *widths, 1]
    for layer, kernel in enumerate(kernels):
        shape = (channels[layer + 1], channels[layer], kernel, kernel)
        made[f"dae/layers.{layer}.weight"] = numbers.normal(size=shape)
        made[f"dae/layers.{layer}.bias"] = numbers.normal(size=shape[:1])
    made = {name: values.astype(np.float32) for name, values in made.items()}
    variance = {"flux/variance": np.sort(numbers.random(kept)), "flux/rest": np.array(1e-9)}
    same = {name: arrays[name] for name in ("noise_nodes", "distance_limit")}
    sizes = {"stamp_px": side, "components": kept, "pixel_scale_arcsec": 0.1}
    return info | sizes | {"dae": {"kernels": kernels, "widths": widths}}, made | variance | same


def nudged(array, rng):
    """Nearly the same array: what a fit might have left."""
    numbers = np.random.default_rng(rng.randrange(10**6))
    size = rng.choice([1e-6, 1e-4, 1e-3, 1e-2, 0.1])
    what = rng.randrange(4)
    if what == 0:
        found = array * (1 + size)
    elif what == 1:
        found = array * (1 + size * numbers.standard_normal(array.shape))
    elif what == 2:
        found = array + size * np.abs(array).max(initial=0) * numbers.standard_normal(array.shape)
    else:
        found = array.copy()
        found.reshape(-1)[rng.randrange(max(array.size, 1)) :][:1] *= 1 + 10 * size
    return np.asarray(found, array.dtype)


def another(array, rng):
    """Another array."""
    what = rng.randrange(8)
    if what == 0:
        return np.asarray(array * float(rng.choice(["0", "-1", "1e30", "1e-30"])), array.dtype)
    if what == 1:
        return np.full_like(array, rng.choice([0.0, 1.0, np.nan, np.inf]))
    if what == 2:
        return array.astype(rng.choice([np.int8, np.float16, np.float64, np.bool_, np.uint64]))
    if what == 3:
        return array.reshape(-1)[: rng.choice([0, 1, 7])].copy()
    if what == 4:
        return np.zeros(
            rng.choice([(), (0,), (1, 1), (16, 16), (3, 0, 5), (4096, 300)]), array.dtype
        )
    if what == 5:
        return array.T.copy()
    flat = array.copy().reshape(-1)
    for _ in range(3):
        if flat.size:
            flat[rng.randrange(flat.size)] = rng.choice([0.0, 1e30, -1.0, 5.0])
    return flat.reshape(array.shape)


def sign_bundle(text, arrays):
    from psfdae.model.bundle import _digest

    return text | {"sha256": _digest(text["info"], arrays)}


def sign_weights(text, arrays):
    from psfdae.networks.weights import digest_of

    return text | {"sha256": digest_of(arrays)}


def mutated(raw, name, kind, rng):
    """The file's bytes, changed."""
    if kind == "nudged":
        return tensors(raw, rng, sign_bundle, nudged)
    if kind in ("bundle", "weights"):
        if rng.random() < 0.3:
            return any_bytes(raw, rng)
        return tensors(raw, rng, sign_bundle if kind == "bundle" else sign_weights)
    pack = name.rpartition(".")[2]
    if pack in PACK:
        if rng.random() < 0.3:
            return any_bytes(raw, rng)
        plain = rng.choice([any_bytes, cards])(raw_of(raw, pack), rng)
        plain += bytes(rng.choice([0, 0, 10**6, 2 * 10**7]))
        return PACK[pack](plain)
    if name.endswith((".csv", ".ecsv", ".cat")):
        return rng.choice([any_bytes, cells, cells])(raw, rng)
    return rng.choice([any_bytes, cards, cards])(raw, rng)


def raw_of(packed, pack):
    """The content of a good packed file."""
    if pack == "zip":
        return zipfile.ZipFile(io.BytesIO(packed)).read("a.fits")
    return {"gz": gzip, "bz2": bz2, "xz": lzma}[pack].decompress(packed)


def command(kind, path, out, rng):
    """What a user types."""
    scale = ["--pixel-scale", "0.1"] if rng.random() < 0.8 else []
    tail = [*scale, "--out", str(out), "--threads", "1", "--quiet"]
    if kind == "cube":
        return ["predict", str(path), *tail]
    if kind == "image":
        return ["predict", str(path), "--catalogue", "s.csv", *tail]
    if kind == "catalogue":
        more = rng.choice([[], ["--flux-column", "X_IMAGE"], ["--origin", "0"]])
        return ["predict", "image.fits", "--catalogue", str(path), *more, *tail]
    if kind == "bundle":
        use = ["predict", "image.fits", "--catalogue", "s.csv", "--model", str(path), *tail]
        return rng.choice([["describe", str(path)], use])
    return ["load", str(path)]


# Own stars: models of an image, and what they make of it.

OWN = ["preset=smoke", "parts.train_stars=60", "parts.test_stars=20", "framing.stamp_px=10"]
OWN += ["methods=[noisy,field]", "--method", "field"]
OWN += ["field.orders=[1]", "field.step_px=0.5", "field.modes=10"]  # a fourth of the work each

FEW = {"LEAST_STARS": 60, "FEW_STARS": 40, "NODES": 4}
"""Of `psfdae.model.packing`: a model that is trained in a second says little of its errors."""


def write_own(folder):
    """An image with its lists and maps, of two chips, and a model of it."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    from astropy.io import fits
    from astropy.table import Table

    from command_line import psfdae
    from psfdae.commands import mosaic
    from psfdae.model import packing
    from psfdae_paper.stages import simulate

    for name, value in FEW.items():
        setattr(packing, name, value)
    small = {"side_px": 320, "bright": 34, "faint": 8, "blended": 1, "saturated": 1}
    simulate.write_example(folder / "own.fits", folder / "own.csv", seed=5, **small)
    table = Table.read(folder / "own.csv")
    table["X_IMAGE", "Y_IMAGE"].write(folder / "own_list.fits")
    table["ra", "dec"].write(folder / "own_sky.csv")
    data, header = fits.getdata(folder / "own.fits", header=True)
    chips = [fits.ImageHDU(data, header, name=f"CHIP{n}") for n in (1, 2)]
    fits.HDUList([fits.PrimaryHDU(), *chips]).writeto(folder / "mosaic.fits")
    holes = np.ones(data.shape, np.float32)
    holes[100:140, 60:200] = holes[:, 17] = 0.0
    for name, values in (("holes", holes), ("zeros", 0 * holes), ("sigma2", 400 * holes + 1)):
        fits.writeto(folder / f"{name}.fits", values, overwrite=True)
    words = ["from-stars", "own.fits", "--catalogue", "own.csv", "--out", "model", *OWN]
    done = psfdae(*words)
    assert done.exit_code == 0, done.output
    (folder / "model" / "own.psf.safetensors").rename(folder / "own.psf.safetensors")
    shutil.rmtree(folder / "model")
    # Workers that have imported everything, as their parent has: others would take seconds.
    forked = multiprocessing.get_context("fork")
    mosaic._pool = lambda processes: ProcessPoolExecutor(processes, forked)
    rng = random.Random(0)
    for kind in OWN_GOOD:
        psfdae(*own_command(kind, folder / OWN_GOOD[kind][0], folder / "warm.fits", rng))
    for left in folder.glob("warm*"):
        shutil.rmtree(left) if left.is_dir() else left.unlink()


OWN_GOOD = {
    "image": ["own.fits"],
    "catalogue": ["own.csv", "own_list.fits", "own_sky.csv"],
    "mosaic": ["mosaic.fits"],
    "bundle": ["own.psf.safetensors"],
    "nudged": ["own.psf.safetensors"],
    "psf": ["own.psf.safetensors"],
    "map": ["holes.fits", "sigma2.fits"],
    "stars": ["own.fits", "own.csv"],
}


def own_command(kind, path, out, rng):
    """What a user types."""
    use = ["--model", "own.psf.safetensors", "--out", str(out), "--threads", "1", "--quiet"]
    lists = rng.choice([["--catalogue", "own.csv"], ["--detect"]])
    more = rng.choice(
        [
            *([], [], ["--gain", "1e12"], ["--saturate", "3e4"], ["--weight", "0"]),
            *(["--weight", "holes.fits"], ["--weight", "zeros.fits"], ["--mask", "holes.fits"]),
            *(["--variance", "sigma2.fits"], ["--mask", "zeros.fits", "--bad-bits", "4"]),
        ]
    )
    place = rng.choice(["--grid=3x2", "--at=200,100.4", "--at=1e300,-5", "--grid=15x9"])
    step = rng.choice([[], ["--oversampling", "1"], ["--oversampling", "7"]])
    if kind == "image":
        return ["predict", str(path), *lists, *more, *use]
    if kind == "map":
        option = rng.choice(["--weight", "--variance", "--mask"])
        return ["predict", "own.fits", *lists, option, str(path), *use]
    if kind == "catalogue":
        fixed = rng.choice([[], ["--fixed-positions"]])
        return ["predict", "own.fits", "--catalogue", str(path), *fixed, *use]
    if kind == "mosaic":
        lists = rng.choice([["--catalogue", "own_sky.csv"], ["--detect"]])
        if rng.random() < 0.1:
            return [
                "from-stars",
                str(path),
                "--all-extensions",
                *lists,
                *_trained(out, rng.random() < 0.2),
            ]
        return ["predict", str(path), "--all-extensions", *lists, *use]
    if kind == "psf" or (kind == "nudged" and rng.random() < 0.5):
        return ["psf", str(path), place, *step, "--out", str(out)]
    if kind in ("bundle", "nudged"):
        return ["predict", "own.fits", *lists, "--model", str(path), *use[2:]]
    words = ["--catalogue", str(path)] if path.suffix == ".csv" else lists
    image = "own.fits" if path.suffix == ".csv" else path
    return ["from-stars", str(image), *words, *more, *_trained(out, rng.random() < 0.2)]


def _trained(out, page):
    """What `from-stars` is told."""
    more = ["--report", str(out.with_suffix(".html"))] if page else []
    return ["--out", str(out.with_suffix("")), *more, *OWN]


def unlikely(path, judged):
    """What is wrong with stars or PSFs that a file shows without a flag, or None.

    These are counted.
    """
    from astropy.io import fits

    with fits.open(path) as hdus:
        if len(hdus) == 1:
            psf, step = hdus[0].data.astype(float), int(hdus[0].header["OVERSAMP"])
            side = psf.shape[-1] - (step > 1)
            flux, reach, numbers = np.ones(len(psf)), 2 * step, []
            inside = psf[:, :side:step, :side:step]
        else:
            stars = hdus["STARS"].data
            good = stars["flags"] == 0
            inside = psf = hdus["PSF"].data[good].astype(float)
            flux, reach = stars["flux"][good].astype(float), 2
            numbers = [stars[n][good] for n in ("noise", "snr", "chi2", "flux_error")]
            doubt = hdus["UNCERT"].data[good]
            if not (np.isfinite(doubt).all() and (doubt >= 0).all()):
                return "UNCERT is not finite, or negative"
            if not all(np.isfinite(n).all() and (n > 0).all() for n in numbers[:3]):
                return "numbers are not finite, or not positive"
            if (numbers[2] >= 10).any():
                return f"chi2 of {numbers[2].max():.3g}"
    judged.update({"files": 1, "stars" if numbers else "psfs": len(psf)})
    if not (np.isfinite(psf).all() and np.isfinite(flux).all() and (flux > 0).all()):
        return "not finite, or no flux"
    if not len(psf):
        return None
    total = inside.sum(axis=(1, 2)) / flux
    if np.abs(total - 1).max() > 0.05:
        return f"sums from {total.min():.4g} to {total.max():.4g}"
    peak = np.stack(np.unravel_index(psf.reshape(len(psf), -1).argmax(axis=1), psf.shape[1:]))
    if np.abs(peak - psf.shape[-1] // 2).max() > reach:
        return "peak is not in the middle"
    return None


def seen(folder, judged):
    """What is wrong with files that a command has left, and with what its models make, or None."""
    wrong = None
    for model in folder.glob("out/*.psf.safetensors"):
        use = ["--model", str(model), "--out", str(folder / "out.fits"), "--threads", "1"]
        again = ["predict", "own.fits", "--catalogue", "own.csv", *use]
        wrong = wrong or attempt(again, folder / "log")[0]
    for file in folder.glob("out*.fits"):
        wrong = wrong or unlikely(file, judged)
    return wrong


# Running.


def run(words):
    """The command in this process; never returns."""
    from psfdae.cli import Careful, main

    if words[0] == "load":
        import click

        from psfdae.networks.weights import load_weights

        path = Path(words.pop())
        load = click.Command("load", callback=lambda: load_weights(path))
        main = Careful(commands={"load": load})
    code = 1
    try:
        main(words, prog_name="psfdae")
    except SystemExit as stop:
        code = stop.code or 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def data_bytes():
    """Private memory of this process."""
    text = Path("/proc/self/status").read_text()
    return 1024 * int(re.search(r"VmData:\s+(\d+)", text)[1])


def attempt(words, log):
    """Run a command in a child: what is wrong with it (or None), exit code, seconds."""
    start = time.monotonic()
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_DATA, (data_bytes() + BYTES,) * 2)
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, 1)
        os.dup2(file, 2)
        run(words)
    while (done := os.wait4(child, os.WNOHANG))[0] == 0:
        time.sleep(0.005)
        if time.monotonic() - start > 60 * SECONDS:  # hangs without working
            os.kill(child, 9)
    seconds = done[2].ru_utime + done[2].ru_stime
    code = os.waitstatus_to_exitcode(done[1])
    text = Path(log).read_text(errors="replace")
    return verdict(code, text), code, seconds


def verdict(code, text):
    """What is wrong with an end, or None."""
    lines = [line for line in text.splitlines() if line]
    if code < 0:
        return f"killed by signal {-code}"
    if "Traceback" in text or code not in (0, 2):
        return f"exit code {code}"
    lines = [line for line in lines if line.startswith("psfdae: ")] if "images:" in text else lines
    if code == 2 and (len(lines) != 1 or not lines[0].startswith("psfdae: ")):
        return f"{len(lines)} lines"
    if code == 2 and re.search("fit into memory|not enough memory", text):
        return "more memory than allowed"
    if any(not c.isprintable() and c != "\n" for c in text):
        return "escape sequences"
    return None


def hostile(count, seed, kept, own=False):
    """Try so many inputs; a summary as a dict."""
    good, typed = (OWN_GOOD, own_command) if own else (GOOD, command)
    kinds = ["cube", "image", "catalogue", "bundle", "bundle", "weights"]
    kinds = [*good, "catalogue", "nudged", "psf"] if own else kinds
    kept = Path(kept)
    kept.mkdir(parents=True, exist_ok=True)
    tally, judged, broken, slowest = Counter(), Counter(), [], 0.0
    with tempfile.TemporaryDirectory() as name:
        os.chdir(name)
        folder = Path(name)
        (write_own if own else write_good)(folder)
        raw = {path.name: path.read_bytes() for path in folder.iterdir()}
        if not own:
            warm_up(folder)
        for number in range(count):
            rng = random.Random(f"{seed} {number}")
            kind = rng.choice(kinds)
            source = rng.choice(good[kind])
            path = folder / f"bad_{source}"
            made = mutated(raw[source], source, "bundle" if kind == "psf" else kind, rng)
            path.write_bytes(made)
            out = folder / "out.fits"
            words = typed(kind, path, out, rng)
            wrong, code, seconds = attempt(words, folder / "log")
            slowest = max(slowest, seconds)
            if own:
                wrong = wrong or seen(folder, judged)
            elif wrong is None and (code == 0) != out.exists() and words[0] == "predict":
                wrong = "out.fits beside an error" if code else "no out.fits"
            tally[f"{kind} {code}"] += 1
            if number % 50 == 49:
                print(number + 1, dict(tally), dict(judged), file=sys.stderr, flush=True)
            if wrong:
                shutil.copy(path, kept / f"{number}_{source}")
                text = (folder / "log").read_text(errors="replace")[-400:]
                broken.append({"number": number, "words": words, "wrong": wrong, "log": text})
                print(broken[-1], file=sys.stderr, flush=True)
            out.unlink(missing_ok=True)
            path.unlink()
            for left in folder.glob("out*") if own else ():
                shutil.rmtree(left) if left.is_dir() else left.unlink()
            for left in folder.iterdir():
                if left.name not in raw and left.name != "log":
                    broken.append({"number": number, "wrong": f"left {left.name}"})
                    left.unlink()
        os.chdir("/")
    return {
        "inputs": count,
        "ends": dict(sorted(tally.items())),
        "judged": judged,
        "slowest_s": slowest,
        "broken": broken,
    }


def warm_up(folder):
    """Import all that a command imports; good files are accepted."""
    from command_line import psfdae

    rng = random.Random(0)
    for kind in ("cube", "image", "catalogue", "bundle"):
        for name in GOOD[kind]:
            out = folder / "out.fits"
            words = command(kind, folder / name, out, rng)
            if kind == "image":
                words += ["--mask", "image.fits", "--pixel-scale", "0.1"]
            result = psfdae(*words)
            assert result.exit_code == 0, (words, result.output)
            out.unlink(missing_ok=True)
            if kind == "bundle":
                psfdae("describe", folder / name)


if __name__ == "__main__":
    asked = [word for word in sys.argv[1:] if word != "own"]
    number, seed, kept = (asked + ["1", "hostile"][len(asked) - 1 :])[:3]
    found = hostile(int(number), int(seed), kept, "own" in sys.argv)
    print(json.dumps(found, indent=1))
    sys.exit(bool(found["broken"]))
