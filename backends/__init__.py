"""Fusion backends behind one protocol: `create("open3d", voxel_size=0.2, num_classes=7)`.

Examples:
    >>> backend = semstab.backends.create("numba", voxel_size=0.5, num_classes=3)
    >>> backend.integrate(frames[0]).map_voxels == len(backend.table())
    True
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from functools import partial
from typing import Any, Protocol, cast

from semstab.core.registry import BY_RULE, Registration, Registry
from semstab.data.events import Events
from semstab.data.frames import Frame
from semstab.data.results import Changes, FrameReport
from semstab.data.voxels import Extent, VoxelTable
from semstab.errors import ConfigError

OPEN3D_LIBRARIES = "libusb-1.0-0 libegl1 libgl1 libx11-6 libudev1 libidn2-0 libgomp1"

GIVEN = ("voxel_size", "num_classes", "within")
"""Settings of every map; the rest are options of its backend."""

WITH_OPEN3D = f"pip install semstab, and on Debian or Ubuntu: apt-get install {OPEN3D_LIBRARIES}"

REGISTRY = Registry(
    "backend",
    {
        "numpy": Registration(
            "semstab.backends.numpy_reference:NumpyReference",
            "the reference: each metric from its definition",
        ),
        "numba": Registration(
            "semstab.backends.numba_hash:NumbaHash",
            "the fastest on a CPU: a hash map in compiled code",
            install="pip install semstab",
        ),
        "open3d": Registration(
            "semstab.backends.open3d_blocks:Open3DBlocks",
            "Open3D's VoxelBlockGrid with semantics; CPU or CUDA",
            install=WITH_OPEN3D,
            needs=("open3d",),
        ),
        "torch": Registration(
            "semstab.backends.torch_map:TorchMap",
            "the fastest on a CUDA device: a hash map of tensors",
            install="pip install 'semstab[torch]'",
            needs=("torch",),
        ),
        "open3d-projective": Registration(
            "semstab.backends.open3d_projective:Open3DProjective",
            "voxels look up their pixel, as Open3D's integration",
            install=WITH_OPEN3D,
            needs=("open3d",),
        ),
    },
)


class FusionBackend(Protocol):
    """A fusion of frames into metric voxels, made with `voxel_size` (metres), `num_classes` (K >= 2) and own options.

    A pixel (u, v) with depth d falls into the voxel floor(x_w / r), evaluated in float64 in this order, so that
    every backend assigns a point on a voxel's face to the same voxel:

        x_c = ((u - cx) / fx) * d        y_c = ((v - cy) / fy) * d        z_c = d
        x_w = ((R00 * x_c + R01 * y_c) + R02 * z_c) + t0     and so on

    A voxel takes one evidence vector a frame: the mean over the frame's pixels in it, a distribution over the classes.
    So the rows of evidence in the table sum to OP; a run with other rows fails. A backend that fuses otherwise (votes
    of pixels, products of likelihoods, weights, forgetting) gives the table a `weight`, to which each row sums: then
    VSS, entropy, margin, labels, SBD and OP hold, and what counts frames (PSA, voxel alpha, the null of drift) is NaN.
    `semstab.backends.from_observations` has a base class with one method, and rules for it.

    A backend that associates pixels and voxels in another way says `pointwise = False`: it is compared with the
    others, but they need not agree.

    A static method `check_options(voxel_size, num_classes, ...)`, with those options that it checks, raises ConfigError
    for values that no map can have: a run calls it before it reads a frame.

    A backend to which growth costs much has `room()`, which returns the size of a map, a whole number in units of its
    own, and `reserve(room)`, which makes as much room in an empty map: a run calls it for each further map of a scene.
    """

    def integrate(self, frame: Frame) -> FrameReport:
        """Fuse one frame: one more observation of the voxels it sees, whatever its index.

        Raises:
            DataError: If the frame cannot be fused, with the map unchanged.
        """

    def table(self) -> VoxelTable:
        """Return the map so far."""

    def events(self) -> Events | None:
        """Return the log of observations, or None without a log."""
        return None

    def changes(self) -> Changes | None:
        """Return the changes by the last frame, for the recording, or None if the backend does not report changes."""
        return None


def rule_of(name: str) -> str:
    """Return the rule in the name of a backend, as 'bayes' of 'numba+bayes'; '' for the backend's own rule."""
    return name.partition(BY_RULE)[2]


def by_own_rule(name: str) -> str:
    """Return the name of a backend without a rule: 'numba' of 'numba+bayes'."""
    return name.partition(BY_RULE)[0]


def is_builtin(name: str) -> bool:
    """Return whether semstab has this backend itself; others come from plug-ins and files."""
    return by_own_rule(name) in REGISTRY.builtin


def _load(name: str) -> Any:
    """Return the class of a backend, or of the one that runs rules for it."""
    base_name, by, _ = name.partition(BY_RULE)
    cls = REGISTRY.load(base_name)
    if not by or "rule" in _options(cls):
        return cls
    from semstab.backends.from_observations import RULED

    if base_name not in RULED:
        raise ConfigError(
            f"backend '{base_name}' has no rules but the mean; {' and '.join(RULED)} have, and subclasses of"
            " semstab.backends.from_observations.FromObservations"
        )
    return RULED[base_name]


def check_options(name: str, *, voxel_size: float, num_classes: int, **options: Any) -> None:
    """Check the settings of a backend's maps by its `check_options`; the first map of a class without one checks them.

    Raises:
        ConfigError: For an unknown name or option, and for a value that the backend does not take.
        MissingDependencyError: If its engine is not installed.
    """
    name, options = _with_rule(name, options)
    check = getattr(_class(name, options), "check_options", None)
    if check is not None:
        taken = inspect.signature(check).parameters
        check(voxel_size, num_classes, **{option: value for option, value in options.items() if option in taken})


def create(
    name: str, *, voxel_size: float, num_classes: int, within: Extent | None = None, **options: Any
) -> FusionBackend:
    """Return a new, empty map, restricted to the voxels `within` an extent where one is given.

    voxel_size in metres, num_classes K >= 2; options are the backend's own (open3d: device, block_resolution).

    Raises:
        ConfigError: For an unknown name or option, a value that the backend does not take, and for an extent where the
            backend does not associate pixel by pixel.
        MissingDependencyError: If its engine is not installed.
    """
    if not isinstance(within, Extent | None):
        raise ConfigError(f"backend '{name}' has no option 'within'; the plan sets it")
    name, options = _with_rule(name, options)
    cls = _class(name, options)
    make: Any = partial(cls, voxel_size=voxel_size, num_classes=num_classes, **options)
    if within is None:
        return cast(FusionBackend, make())
    if not is_pointwise(name):
        raise ConfigError(f"backend '{name}' does not associate pixel by pixel; it cannot be restricted to a part")
    if "within" in inspect.signature(cls).parameters:
        return cast(FusionBackend, make(within=within))
    from semstab.backends.shared.association import Restricted

    return Restricted(make(), voxel_size, within)


def _with_rule(name: str, options: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return name and options that both have the rule: 'numba' with rule='bayes' and 'numba+bayes' become the same.

    The rule of the options counts; the name may have any other word for it. 'mean' is the backend without a rule.
    """
    rule = options.get("rule", rule_of(name))
    if not isinstance(rule, str):
        raise ConfigError(f"backend '{name}': rule = {rule!r}: use a name, or FILE.py:NAME")
    if not rule:
        return name, options
    if rule == "mean" and name in REGISTRY.entries():
        return name, {key: value for key, value in options.items() if key != "rule"}
    return name if rule_of(name) else f"{name}{BY_RULE}{rule}", options | {"rule": rule}


def _class(name: str, options: Mapping[str, Any]) -> Any:
    """Return the class of that name; raises ConfigError if it has no such options."""
    cls = _load(name)
    available = _options(cls)
    if unknown := sorted(set(options) - set(available) | set(options) & set(GIVEN)):
        listed = f"it takes {', '.join(available)}" if available else "it takes none"
        raise ConfigError(f"backend '{name}' has no option '{unknown[0]}'; {listed}")
    try:
        inspect.signature(cls).bind(voxel_size=1.0, num_classes=2, **options)
    except TypeError as error:
        raise ConfigError(
            f"backend '{name}' cannot be made with voxel_size and num_classes ({error}): __init__(self, *, voxel_size,"
            " num_classes)"
        ) from error
    return cls


def changes_of(backend: FusionBackend) -> Changes | None:
    """Return the changes of a backend's map by the last frame, or None: an outside backend need not say them."""
    return backend.changes() if hasattr(backend, "changes") else None


def is_pointwise(name: str) -> bool:
    """Return whether the backend of that name associates pixel by pixel, as the reference does.

    Only then its maps can be restricted to an extent. Whether they must agree with the others may be configured, too:
    see `semstab.engine.units.must_agree`.
    """
    return bool(getattr(_load(name), "pointwise", True))


def takes_option(name: str, option: str) -> bool:
    """Return whether the backend of that name has such an option, for example 'device'."""
    return option in _options(_load(name))


def keeps_log(name: str) -> bool:
    """Return whether the backend of that name can give a log of observations: with option `history`, or always."""
    return takes_option(name, "history") or getattr(_load(name), "keeps_log", False)


def expected_bytes(name: str, voxels: int, observations: int, num_classes: int, *, soft: bool = False) -> int:
    """Return the bytes that a backend's map of that size takes, roughly; 0 for one that does not say.

    A backend says it with a static method of that name, those three parameters, and `soft` where a map of scores takes
    other than one of labels.
    """
    says = getattr(_load(name), "expected_bytes", None)
    if says is None:
        return 0
    more = {"soft": soft} if "soft" in inspect.signature(says).parameters else {}
    return int(says(voxels, observations, num_classes, **more))


def _options(cls: Any) -> list[str]:
    return [name for name in inspect.signature(cls).parameters if name not in GIVEN]
