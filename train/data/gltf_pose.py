"""The pose in which a glTF file shows its meshes, by bones and by weights of morph targets; trimesh reads neither."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from scipy.spatial import transform

DRACO = "KHR_draco_mesh_compression"


class Document(Protocol):
    """What is needed of a file whose data is in one buffer; see `train.data.gltf`."""

    scene: dict[str, Any]

    def read_scaled(self, accessor: dict[str, Any]) -> np.ndarray: ...

    def add(self, values: np.ndarray, component: int, kind: str) -> int: ...


def pose(document: Document) -> None:
    """Gives each mesh of the scene that has bones or weights a copy with the vertices where they are to be seen.

    The place of a node does not count for a mesh with bones: the copy hangs on a new node.
    """
    nodes, meshes = document.scene.get("nodes", []), document.scene.get("meshes", [])
    roots = document.scene["scenes"][document.scene.get("scene", 0)].get("nodes", [])
    worlds = _worlds(nodes, roots)
    for number in worlds:
        node = nodes[number]
        mesh = meshes[node["mesh"]] if "mesh" in node else {"primitives": ()}
        weights = node.get("weights", mesh.get("weights", ()))
        bones = _bones(document, node["skin"], worlds) if "skin" in node else None
        if (bones is None and not any(weights)) or any(map(is_compressed, mesh["primitives"])):
            continue
        meshes.append({"primitives": [_posed(document, each, weights, bones) for each in mesh["primitives"]]})
        node["mesh"] = len(meshes) - 1
        if bones is not None:
            roots.append(len(nodes))
            nodes.append({"mesh": node.pop("mesh")})


def is_compressed(primitive: dict[str, Any]) -> bool:
    """Whether only trimesh can read a primitive's data."""
    return DRACO in primitive.get("extensions", {})


def _worlds(nodes: Sequence[dict[str, Any]], roots: Sequence[int]) -> dict[int, np.ndarray]:
    """The matrix (4, 4) from each node of a scene to the scene, for column vectors."""
    worlds: dict[int, np.ndarray] = {}
    waiting = [(root, np.eye(4)) for root in roots]
    while waiting:
        number, around = waiting.pop()
        if number not in worlds:
            worlds[number] = around @ _matrix(nodes[number])
            waiting += [(child, worlds[number]) for child in nodes[number].get("children", ())]
    return worlds


def _matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T
    matrix = np.eye(4)
    if any(rotation := node.get("rotation", ())):  # some writers have four zeros for none
        matrix[:3, :3] = transform.Rotation.from_quat(rotation).as_matrix()
    matrix[:3, :3] *= node.get("scale", (1, 1, 1))
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _bones(document: Document, skin: int, worlds: dict[int, np.ndarray]) -> np.ndarray:
    """(joints, 4, 4): from the vertices as they are stored to the scene."""
    described = document.scene["skins"][skin]
    bones = np.stack([worlds.get(joint, np.eye(4)) for joint in described["joints"]])
    if "inverseBindMatrices" not in described:
        return bones
    stored = document.read_scaled(document.scene["accessors"][described["inverseBindMatrices"]])
    return bones @ stored[: len(bones)].reshape(-1, 4, 4).transpose(0, 2, 1)


def _posed(
    document: Document, primitive: dict[str, Any], weights: Sequence[float], bones: np.ndarray | None
) -> dict[str, Any]:
    accessors, attributes = document.scene["accessors"], primitive["attributes"]
    points = document.read_scaled(accessors[attributes["POSITION"]])
    for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
        if weight and "POSITION" in target:
            points = points + weight * document.read_scaled(accessors[target["POSITION"]])
    sets = [name.removeprefix("WEIGHTS") for name in attributes if name.startswith("WEIGHTS_")]
    if bones is not None and sets:
        blends = np.zeros((len(points), 4, 4))
        for name in sets:
            joints = document.read_scaled(accessors[attributes[f"JOINTS{name}"]]).astype(int)
            shares = document.read_scaled(accessors[attributes[f"WEIGHTS{name}"]])
            for joint, share in zip(joints.T, shares.T, strict=True):
                blends += share[:, None, None] * bones[joint]
        total = blends[:, 3:, 3:]  # of the shares
        blends = np.where(total > 0, blends / np.where(total > 0, total, 1), np.eye(4))
        points = np.einsum("nij,nj->ni", blends[:, :3, :3], points) + blends[:, :3, 3]
    return {**primitive, "attributes": {**attributes, "POSITION": document.add(points, 5126, "VEC3")}}
