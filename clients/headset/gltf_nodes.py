"""Placement of the meshes of a glTF file, by its tree of nodes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from clients.headset.gltf_container import Container
from clients.headset.poses import rotation_of
from clients.scenes.geometry import Array

MAX_NODE_DEPTH = 1000
"""Nesting depth of nodes: a skeleton has about 20, and a chain of links about 100."""

_SIZES = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}


def placed_meshes(file: Container) -> Iterator[tuple[Array, int]]:
    """Yield (world_from_mesh, mesh index) for each placed mesh of the default scene.

    The matrices are (4, 4). The traversal is not recursive.

    Raises
    ------
    InvalidFile
        If the nodes do not form a tree, are nested too deep, or have transformations
        that are not finite.
    """
    if not file.list_of("scenes"):
        return
    scene = file.entry("scenes", file.header.get("scene", 0))
    nodes = file.list_of("nodes")
    seen: set[int] = set()
    origin = np.eye(4)
    waiting = [(k, origin, 1) for k in reversed(_numbers(file, scene, "nodes"))]
    while waiting:
        k, world_from_parent, depth = waiting.pop()
        if not 0 <= k < len(nodes):
            file.refuse(f"damaged: node {k}", f"0 to {len(nodes) - 1}")
        if k in seen:
            file.refuse(f"damaged: node {k} occurs twice in the tree", "once")
        if depth > MAX_NODE_DEPTH:
            found_text = f"nodes more than {MAX_NODE_DEPTH} deep"
            file.refuse(found_text, f"at most {MAX_NODE_DEPTH}")
        seen.add(k)
        node = nodes[k]
        with np.errstate(all="ignore"):
            world_from_node = world_from_parent @ _local(file, node, k)
        if not np.isfinite(world_from_node).all():
            file.refuse(
                f"damaged: the transformation of node {k} is not finite", "finite"
            )
        if "mesh" in node:
            file.entry("meshes", node["mesh"])
            yield world_from_node, node["mesh"]
        children = _numbers(file, node, "children")
        waiting += [(c, world_from_node, depth + 1) for c in reversed(children)]


def _numbers(file: Container, entry: dict[str, Any], field: str) -> list[int]:
    found = entry.get(field, [])
    if not isinstance(found, list) or not all(type(k) is int for k in found):
        file.refuse(f"damaged: '{field}' is not a list of integers")
    return found


def _local(file: Container, node: dict[str, Any], k: int) -> Array:
    """Return the matrix (4, 4) from a node's frame to its parent's."""
    values: dict[str, Array] = {}
    for name, size in _SIZES.items():
        given = node.get(name)
        if given is None:
            continue
        is_list = isinstance(given, list) and len(given) == size
        if not is_list or not all(type(v) in (int, float) for v in given):
            file.refuse(f"damaged: nodes[{k}].{name}", f"{size} numbers")
        values[name] = np.array(given, float)
    matrix = np.eye(4)
    if "matrix" in values:
        matrix = values["matrix"].reshape(4, 4).T
    if "translation" in values:
        moved = np.eye(4)
        moved[:3, 3] = values["translation"]
        matrix = matrix @ moved
    if "rotation" in values:
        length = np.linalg.norm(values["rotation"])
        if length > np.finfo(float).tiny:
            matrix[:3, :3] = matrix[:3, :3] @ rotation_of(values["rotation"] / length)
    if "scale" in values:
        matrix = matrix @ np.diag([*values["scale"], 1.0])
    return matrix
