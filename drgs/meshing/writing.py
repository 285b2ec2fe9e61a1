"""Meshes in files: PLY, binary glTF and Wavefront OBJ, each with a color a vertex.

PLY and OBJ keep the axes of the scene. glTF has y up and z to the front, so that x and y turn their signs, as for
Gaussians (`drgs.codecs.gltf`), and colors that are linear: what photographs show is decoded from sRGB. Vertices are
relative to the origin of the mesh, as float32 must be far from 0: the offset that files state as those of Gaussians do
(`comment offset X Y Z` of a PLY, `asset.extras.offset` of glTF in its axes, `# offset X Y Z` of an OBJ).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.codecs.glb import glb_of
from drgs.codecs.ply_headers import offset_line
from drgs.display.srgb import linear_from_srgb
from drgs.io.outputs import replacing

if TYPE_CHECKING:
    from drgs.meshing.extraction import TriangleMesh

MESH_SUFFIXES = (".ply", ".glb", ".obj")
"""Of the formats that are written."""
_TURN = np.array([-1.0, -1.0, 1.0])  # half a turn about z: no mirror, so that triangles keep their order


def save_mesh(mesh: TriangleMesh, path: Path) -> None:
    """Write a mesh; the file appears once it is complete.

    Args:
        mesh: The mesh. A PLY also has the number of views of each vertex and, where it is known, its spread.
        path: File, whose suffix (`MESH_SUFFIXES`) says the format.
    Raises:
        ValueError: If the suffix is another one.
        OSError: If it cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise ValueError(
            f"{path}: a mesh must be a {', '.join(MESH_SUFFIXES)}, got {suffix or 'no suffix'!r}; rename it"
        )
    with replacing(path, suffix) as name:
        if suffix == ".ply":
            _write_ply(mesh, name)
        elif suffix == ".glb":
            Path(name).write_bytes(_glb(mesh))
        else:
            _write_obj(mesh, name)


def _write_ply(mesh: TriangleMesh, name: str) -> None:
    """Elements `vertex` and `face`, binary little-endian, as MeshLab and Blender read them."""
    import plyfile

    columns = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("views", "u2")]
    rows = np.empty(len(mesh.vertices), [*columns, *([("spread", "f4")] if mesh.spread is not None else [])])
    for k, axis in enumerate("xyz"):
        rows[axis] = mesh.vertices[:, k]
    for k, color in enumerate(("red", "green", "blue")):
        rows[color] = np.rint(mesh.colors[:, k] * 255)
    rows["views"] = np.minimum(mesh.views, 65535)
    if mesh.spread is not None:
        rows["spread"] = mesh.spread
    faces = np.empty(len(mesh.faces), [("vertex_indices", "i4", (3,))])
    faces["vertex_indices"] = mesh.faces
    elements = [plyfile.PlyElement.describe(rows, "vertex"), plyfile.PlyElement.describe(faces, "face")]
    comments = [offset_line(mesh.origin)] if mesh.origin.any() else []
    plyfile.PlyData(elements, byte_order="<", comments=comments).write(name)


def _write_obj(mesh: TriangleMesh, name: str) -> None:
    with open(name, "w", encoding="ascii") as file:
        file.write("# vertices: x y z r g b, colors in [0, 1]\n")
        if mesh.origin.any():
            file.write(f"# {offset_line(mesh.origin)}\n")
        np.savetxt(file, np.column_stack([mesh.vertices, mesh.colors]), "v %.7g %.7g %.7g %.4f %.4f %.4f")
        np.savetxt(file, mesh.faces + 1, "f %d %d %d")


def _glb(mesh: TriangleMesh) -> bytes:
    """A GLB of one primitive of triangles: POSITION, COLOR_0 and indices, as glTF 2.0 has them."""
    positions = np.ascontiguousarray(mesh.vertices * _TURN, "<f4")
    linear = linear_from_srgb(mesh.colors.astype(np.float64))
    opaque = np.full((len(linear), 1), 65535)  # four channels: each vertex starts at a multiple of four bytes
    arrays = [
        (positions, {"componentType": 5126, "type": "VEC3"}, 34962),
        (
            np.column_stack([np.rint(linear * 65535), opaque]).astype("<u2"),
            {"componentType": 5123, "normalized": True, "type": "VEC4"},
            34962,
        ),
        (mesh.faces.astype("<u4").reshape(-1), {"componentType": 5125, "type": "SCALAR"}, 34963),
    ]
    rough = {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 0, "roughnessFactor": 1}
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0, "mode": 4}
    materials = {"materials": [{"pbrMetallicRoughness": rough, "doubleSided": True}]}
    return glb_of("mesh", arrays, primitive, materials, mesh.origin * _TURN)
