"""One small valid file of every format that is read, and what its Gaussians are, computed by hand from the layouts."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import splat_encoders as encode

Y_00 = 0.28209479177387814
NAMES = (
    "v2.spz", "v3.spz", "v4.spz", "raw.spz", "a.splat", "0.ksplat", "1.ksplat", "2.ksplat", "packed.ply", "a.sog",
    "a.glb",
)  # fmt: skip
N = 5


def logits(x):
    return np.log(x) - np.log1p(-np.asarray(x))


def unit(rng, n=N):
    q = rng.normal(size=(n, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def write_sample(path: Path, name: str, rng) -> dict[str, np.ndarray]:
    """Write the sample; what must be read of it: fields of Gaussians in the axes of PLY files."""
    data, fields = _MAKERS[name](rng)
    path.write_bytes(data)
    return fields


def _spz(version: int, degree: int, packed: bool = True):
    def make(rng):
        positions = rng.integers(-(1 << 23), 1 << 23, (N, 3))
        alphas, colors, scales = (rng.integers(0, 256, (N, k), dtype=np.uint8) for k in (1, 3, 3))
        alphas[:2, 0] = 0, 255
        sh = rng.integers(0, 256, (N, (degree + 1) ** 2 - 1, 3), dtype=np.uint8)
        quats = unit(rng)  # wxyz
        if version == 2:
            quats[:, 0] = np.abs(quats[:, 0]) + 0.5  # w is computed of the others: the smaller it is, the less exactly
            quats /= np.linalg.norm(quats, axis=1, keepdims=True)
            stored = np.round(quats[:, 1:] * 127.5 + 127.5).astype(np.uint8)
        else:
            stored = np.array([smallest_three(q[[1, 2, 3, 0]]) for q in quats], "<u4")
        parts = (positions, alphas, colors, scales, stored, sh)
        if version == 4:
            split = [encode.spz_body(positions, b"", b"", b"", b"", b"")]
            split += [np.ascontiguousarray(x).tobytes() for x in parts[1:] if np.asarray(x).size]
            data = encode.spz_file_4(degree, split, N)
        else:
            data = encode.spz_file(version, degree, encode.spz_body(*parts), N, packed=packed)
        alpha = np.clip(alphas[:, 0] / 255.0, 0.25 / 255, 254.75 / 255)
        flips = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])  # of (x, -y, -z), degree by degree
        all_sh = np.concatenate([(colors[:, None] / 255 - 0.5) / 0.15, (sh - 128.0) / 128], axis=1)
        return data, {
            "means": positions / 4096 * [1, -1, -1],
            "quats": quats * [1, 1, -1, -1],
            "log_scales": scales / 16 - 10,
            "logit_opacities": logits(alpha),
            "sh": all_sh * flips[: all_sh.shape[1], None],
        }

    return make


def smallest_three(xyzw) -> int:
    """As the format packs a unit quaternion."""
    largest = int(np.abs(xyzw).argmax())
    sign = -1 if xyzw[largest] < 0 else 1
    code = largest
    for i in range(4):
        if i != largest:
            value = sign * xyzw[i]
            code = code << 10 | (value < 0) << 9 | int(511 * abs(value) * 2**0.5 + 0.5)
    return code


def _splat(rng):
    means, scales = rng.normal(size=(N, 3)).astype("f4"), rng.uniform(0.01, 1, (N, 3)).astype("f4")
    scales[3, 1] = 0
    rgba, quats = rng.integers(0, 256, (N, 4)), unit(rng)
    rgba[:2, 3] = 0, 255
    stored = np.clip(np.round(quats * 128 + 128), 0, 255).astype(int)
    return encode.splat_file(means, scales, rgba, stored), {
        "means": means,
        "quats": quats,
        "log_scales": np.log(np.where(scales == 0, np.finfo("f4").tiny, scales).astype(float)),
        "logit_opacities": logits(np.clip(rgba[:, 3] / 255, 0.25 / 255, 254.75 / 255)),
        "sh": (rgba[:, None, :3] / 255 - 0.5) / Y_00,
    }


def _ksplat(level: int):
    def make(rng):
        degree, coefficients = 2, 8
        sections, fields = [], {key: [] for key in ("means", "quats", "log_scales", "logit_opacities", "sh")}
        for n, full, partial in ((N, 1, [2, 1]), (2, 0, [2])):  # two of the first five lie in a full bucket
            centers = rng.normal(size=(full + len(partial), 3)).astype("f4")
            bucket = np.repeat(np.arange(len(centers)), [2] * full + partial)
            quats, rgba = unit(rng, n), rng.integers(0, 256, (n, 4))
            scales = rng.uniform(0.01, 1, (n, 3)).astype("f4" if level == 0 else "f2")
            sh = rng.uniform(-1, 1, (n, coefficients, 3))
            means = rng.normal(size=(n, 3)) if level == 0 else rng.integers(0, 65535, (n, 3))
            bytes_of = np.round((sh + 1.5) / 3 * 255).astype(int) if level == 2 else sh
            # Channel by channel within a degree.
            flat = np.concatenate([bytes_of[:, a:b].transpose(0, 2, 1).reshape(n, -1) for a, b in ((0, 3), (3, 8))], 1)
            section = {"means": means, "scales": scales, "quats": quats, "rgba": rgba, "sh": flat, "centers": centers}
            sections.append(section | {"full": full, "capacity": 2, "partial": partial, "block": 5.0})
            at = means if level == 0 else (means - 32767) * (2.5 / 32767) + centers[bucket]
            fields["means"].append(at)
            fields["quats"].append(quats)
            fields["log_scales"].append(np.log(scales.astype(float)))
            fields["logit_opacities"].append(logits(np.clip(rgba[:, 3] / 255, 0.25 / 255, 254.75 / 255)))
            fields["sh"].append(np.concatenate([(rgba[:, None, :3] / 255 - 0.5) / Y_00, sh], 1))
        return encode.ksplat_file(level, degree, sections), {key: np.concatenate(x) for key, x in fields.items()}

    return make


def _packed_ply(rng):
    n = 300  # two chunks
    low, high = rng.uniform(-3, 0, (2, 9)), rng.uniform(1, 3, (2, 9))
    ranges = np.concatenate([low[:, :3], high[:, :3], low[:, 3:6], high[:, 3:6], low[:, 6:], high[:, 6:]], 1).astype(
        "f4"
    )
    steps = [
        rng.integers(0, np.array(most) + 1, (n, 3))
        for most in ((2047, 1023, 2047), (2047, 1023, 2047), (255, 255, 255))
    ]
    alpha, quats, sh = rng.integers(0, 256, n), unit(rng, n), rng.integers(0, 256, (n, 24))
    largest = np.abs(quats).argmax(1)
    quats *= np.sign(quats[np.arange(n), largest])[:, None]
    others = quats[np.arange(4) != largest[:, None]].reshape(n, 3)
    q = np.round((others / 2**0.5 + 0.5) * 1023).astype(np.int64)
    vertices = np.stack([
        steps[0][:, 0] << 21 | steps[0][:, 1] << 11 | steps[0][:, 2],
        largest << 30 | q[:, 0] << 20 | q[:, 1] << 10 | q[:, 2],
        steps[1][:, 0] << 21 | steps[1][:, 1] << 11 | steps[1][:, 2],
        steps[2][:, 0] << 24 | steps[2][:, 1] << 16 | steps[2][:, 2] << 8 | alpha,
    ], 1)  # fmt: skip
    chunk = np.arange(n) // 256
    low, high = low.astype("f4").astype(float), high.astype("f4").astype(float)

    def at(part, columns, most):
        t = part / np.array(most)
        return low[chunk][:, columns] * (1 - t) + high[chunk][:, columns] * t

    harmonics = np.where(sh == 0, -4, np.where(sh == 255, 4, ((sh + 0.5) / 256 - 0.5) * 8))
    return encode.packed_ply_file(ranges, vertices, sh), {
        "means": at(steps[0], slice(0, 3), (2047, 1023, 2047)),
        "quats": quats,
        "log_scales": at(steps[1], slice(3, 6), (2047, 1023, 2047)),
        "logit_opacities": logits(np.clip(alpha / 255, 0.25 / 255, 254.75 / 255)),
        "sh": np.concatenate(
            [(at(steps[2], slice(6, 9), 255)[:, None] - 0.5) / Y_00, harmonics.reshape(n, 3, 8).transpose(0, 2, 1)], 1
        ),
    }


def sog_scene(rng, n: int = 70, version: int = 2, degree: int = 2) -> tuple[dict, dict[str, bytes], dict]:
    """meta.json, images and fields of a SOG scene; the palette has two rows of 64 entries."""
    each, entries = (degree + 1) ** 2 - 1, 100
    code, labels = rng.integers(0, 65536, (n, 3)), rng.integers(0, entries, n)
    book = {key: np.sort(rng.normal(size=256) * k) for key, k in (("scales", 2), ("sh0", 1), ("shN", 0.3))}
    scales, base = rng.integers(0, 256, (n, 3)), rng.integers(0, 256, (n, 4))
    base[:2, 3] = 0, 255
    quats = unit(rng, n)
    largest = np.abs(quats).argmax(1)
    quats *= np.sign(quats[np.arange(n), largest])[:, None]
    others = quats[np.arange(4) != largest[:, None]].reshape(n, 3)
    stored = np.concatenate([np.round((others * 2**0.5 + 1) * 127.5), largest[:, None] + 252], 1)
    centroids = rng.integers(0, 256, (entries, each, 3))
    palette = np.zeros((2 * 64, each, 3), np.uint8)
    palette[:entries] = centroids
    low, high = np.array([-2.0, -1, 0]), np.array([1.0, 2, 3])
    wide = low + (high - low) * code / 65535
    images = {
        "means_l.webp": encode.texture(code % 256),
        "means_u.webp": encode.texture(code // 256),
        "quats.webp": encode.texture(stored),
        "scales.webp": encode.texture(scales),
        "sh0.webp": encode.texture(base),
        "shN_labels.webp": encode.texture(np.stack([labels % 256, labels // 256, 0 * labels], 1)),
        "shN_centroids.webp": encode.webp(palette.reshape(2, 64 * each, 3)),
    }
    fields = {"means": np.sign(wide) * np.expm1(np.abs(wide)), "quats": quats}
    files = {key: {"files": [f"{key}.webp"]} for key in ("scales", "quats", "sh0")}
    files["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}
    files["shN"] = {"files": ["shN_centroids.webp", "shN_labels.webp"]}
    if version == 2:
        for key, values in book.items():
            files[key]["codebook"] = values.tolist()
        meta = {"version": 2, "count": n, **files}
        meta["shN"] |= {"count": entries, "bands": degree}
        fields |= {"log_scales": book["scales"][scales], "logit_opacities": logits(
            np.clip(base[:, 3] / 255, 0.25 / 255, 254.75 / 255))}  # fmt: skip
        fields["sh"] = np.concatenate([book["sh0"][base[:, None, :3]], book["shN"][centroids][labels]], 1)
    else:
        ends = {"scales": 3, "sh0": 4}
        for key, width in ends.items():
            files[key] |= {"mins": [-3.0] * width, "maxs": [2.0] * width}
        files["means"]["shape"] = [n, 3]
        files["shN"] |= {"mins": -0.5, "maxs": 0.75}
        meta = files
        fields |= {"log_scales": scales / 51 - 3, "logit_opacities": base[:, 3] / 51 - 3}
        fields["sh"] = np.concatenate([base[:, None, :3] / 51 - 3, centroids[labels] / 204 - 0.5], 1)
    return meta, images, fields


def _sog(rng):
    meta, images, fields = sog_scene(rng)
    return encode.zipped(encode.sog_files(meta, images), method=zipfile.ZIP_DEFLATED), fields


def glb_document(rng, n: int = N, degree: int = 1) -> tuple[dict, bytes, dict]:
    """JSON text, buffer and fields of a glTF with its Gaussians."""
    quats, means = unit(rng, n), rng.normal(size=(n, 3)).astype("f4")
    scales, opacity = rng.uniform(0.01, 2, (n, 3)).astype("f4"), rng.uniform(0.1, 0.9, n).astype("f4")
    sh = rng.normal(size=(n, (degree + 1) ** 2, 3)).astype("f4")
    name = "KHR_gaussian_splatting:"
    arrays = {"POSITION": means, f"{name}ROTATION": quats[:, [1, 2, 3, 0]].astype("f4"), f"{name}SCALE": scales}
    arrays[f"{name}OPACITY"] = opacity[:, None]
    orders = [(d, k) for d in range(degree + 1) for k in range(2 * d + 1)]
    arrays |= {f"{name}SH_DEGREE_{d}_COEF_{k}": sh[:, i] for i, (d, k) in enumerate(orders)}
    views, accessors, buffer = [], [], b""
    for x in arrays.values():
        views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": x.nbytes})
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[x.shape[1]]
        accessors.append({"bufferView": len(views) - 1, "componentType": 5126, "count": n, "type": kind})
        buffer += np.ascontiguousarray(x, "<f4").tobytes()
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    attributes = {key: i for i, key in enumerate(arrays)}
    primitive = {"attributes": attributes, "mode": 0, "extensions": {"KHR_gaussian_splatting": extension}}
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        "buffers": [{"byteLength": len(buffer)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    flips = np.array([1, -1, 1, -1, 1, -1, 1, -1, 1])  # of (-x, -y, z), degree by degree
    return (
        document,
        buffer,
        {
            "means": means * [-1, -1, 1],
            "quats": quats * [1, -1, -1, 1],
            "log_scales": np.log(scales.astype(float)),
            "logit_opacities": logits(opacity.astype(float)),
            "sh": sh * flips[: len(orders), None],
        },
    )


def _glb(rng):
    document, buffer, fields = glb_document(rng)
    return encode.glb_file(document, buffer), fields


_MAKERS = {
    "v2.spz": _spz(2, 1),
    "v3.spz": _spz(3, 3),
    "v4.spz": _spz(4, 2),
    "raw.spz": _spz(3, 0, packed=False),
    "a.splat": _splat,
    "0.ksplat": _ksplat(0),
    "1.ksplat": _ksplat(1),
    "2.ksplat": _ksplat(2),
    "packed.ply": _packed_ply,
    "a.sog": _sog,
    "a.glb": _glb,
}
