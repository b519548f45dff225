"""Distances between classes: of a taxonomy's tree of groups, of a table, or of embeddings of their names."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from semstab.core.files import read_limited
from semstab.core.types import Float64
from semstab.data.features import OF_FEATURES
from semstab.data.labels import LabelSpace, name_key
from semstab.errors import DataError

MOST_BYTES = 64_000_000
SYMMETRIC = 1e-6
"""Largest difference of a distance from a to b and from b to a."""


def distances_of(space: LabelSpace, source: str | Path | None = None) -> Float64 | None:
    """Return distances (K, K) between the classes of a taxonomy, from 0 on; None if all classes have the same distance.

    Args:
        space: The taxonomy, in whose order the rows are.
        source: A file: .csv, a table with the names of classes in its first row and column; .npy, a table (K, K) or
            embeddings (K, D), whose distance is 1 - cosine. Without it, distances are those of the taxonomy's groups,
            if it has some.

    Raises:
        DataError: If the file cannot be used; the message names the row.
    """
    if space == OF_FEATURES:
        return None
    if source is None:
        return tree_distances(space.groups) if any(space.groups) else None
    path = Path(source)
    if path.suffix.lower() == ".csv":
        return _required(_table(path, space), path, space)
    if path.suffix.lower() != ".npy":
        raise DataError(f"{path}: distances between classes are a table (.csv, .npy) or embeddings (.npy)")
    try:
        values = np.load(io.BytesIO(read_limited(path, MOST_BYTES)), allow_pickle=False).astype(np.float64)
    except (OSError, ValueError, TypeError, EOFError) as error:
        raise DataError(f"{path}: it is no .npy of numbers ({type(error).__name__})") from error
    K = len(space)
    if values.ndim != 2 or len(values) != K:
        raise DataError(f"{path}: it has the shape {values.shape}; {space.name} has {K} classes, so ({K}, D) is needed")
    if values.shape == (K, K) and not values.diagonal().any():
        return _required(values, path, space)
    return embedding_distances(values, path, space)


def tree_distances(groups: tuple[str, ...]) -> Float64:
    """Return distances (K, K) of the leaves of a tree, by the groups 'vehicle/car' (K,) that they are in.

    1 - 2 c / (a + b), with depths a and b of two classes and c of the deepest group that holds both (Wu, Palmer 1994,
    Verb Semantics and Lexical Selection, ACL): .5 for two classes of one group, 1 for two that share none.
    """
    paths = [tuple(part for part in group.split("/") if part) for group in groups]
    distances = np.zeros((len(paths), len(paths)))
    for i, one in enumerate(paths):
        for j, other in enumerate(paths):
            if i != j:
                same = [a == b for a, b in zip(one, other, strict=False)]
                common = same.index(False) if False in same else len(same)
                distances[i, j] = 1 - 2 * common / (len(one) + len(other) + 2)
    return distances


def embedding_distances(vectors: Float64, path: Path, space: LabelSpace) -> Float64:
    """Return 1 - cosine (K, K) of embeddings (K, D)."""
    length = np.linalg.norm(vectors, axis=1)
    wrong = np.flatnonzero(~(np.isfinite(length) & (length > 0)))
    if len(wrong):
        raise DataError(f"{path}: the embedding of '{space.classes[wrong[0]]}' has no length or is not finite")
    unit = vectors / length[:, None]
    distances: Float64 = np.clip(1 - unit @ unit.T, 0, 2)
    np.fill_diagonal(distances, 0)
    return _required(distances, path, space)


def _table(path: Path, space: LabelSpace) -> Float64:
    """Return the distances of a CSV table, in the order of the taxonomy."""
    try:
        text = read_limited(path, MOST_BYTES).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: it cannot be read ({type(error).__name__})") from error
    rows = [row for row in csv.reader(io.StringIO(text)) if row]
    names = {name_key(name): k for k, name in enumerate(rows[0][1:] if rows else ())}
    of_row = {name_key(row[0]): row for row in rows[1:]}
    distances = np.zeros((len(space), len(space)))
    for i, name in enumerate(space.classes):
        if (row := of_row.get(name_key(name))) is None or name_key(name) not in names:
            raise DataError(f"{path}: the class '{name}' of {space.name} has no row or no column")
        for j, other in enumerate(space.classes):
            if (column := names.get(name_key(other))) is None:
                raise DataError(f"{path}: the class '{other}' of {space.name} has no column")
            try:
                distances[i, j] = float(row[1 + column])
            except (ValueError, IndexError) as error:
                raise DataError(f"{path}: the distance of '{name}' and '{other}' is no number") from error
    return distances


def _required(distances: Float64, path: Path, space: LabelSpace) -> Float64:
    """Return distances that are finite, symmetric, 0 on the diagonal, not negative and not all 0."""
    at = np.argwhere(~(np.isfinite(distances) & (distances >= 0)))
    if not len(at):
        at = np.argwhere(np.abs(distances - distances.T) > SYMMETRIC)
    if len(at):
        a, b = (space.classes[k] for k in at[0])
        raise DataError(f"{path}: the distance of '{a}' and '{b}' is negative, not finite, or another than back")
    if distances.diagonal().any():
        raise DataError(f"{path}: a class has a distance to itself that is not 0")
    if not distances.any():
        raise DataError(f"{path}: all distances are 0, so that nothing can disagree")
    return (distances + distances.T) / 2
