"""Quaternions of poses in the other order: from a pose as it was read to the pose that was meant."""

from __future__ import annotations

from semstab.core.types import Float64


def first_number_last(T: Float64) -> Float64:
    """Return the pose (4, 4) of the quaternion w x y z that was read as x y z w."""
    from scipy.spatial.transform import Rotation

    turned = T.copy()
    w, x, y, z = Rotation.from_matrix(T[:3, :3]).as_quat()
    turned[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    return turned


def last_number_first(T: Float64) -> Float64:
    """Return the pose (4, 4) of the quaternion x y z w that was read as w x y z."""
    from scipy.spatial.transform import Rotation

    turned = T.copy()
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    turned[:3, :3] = Rotation.from_quat([w, x, y, z]).as_matrix()
    return turned
