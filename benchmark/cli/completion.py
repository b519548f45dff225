"""What the shell completes: names of backends, datasets, backbones, taxonomies, studies, scenes and label sources."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from semstab.errors import SemstabError

Complete = Callable[[Any, str], list[str]]


def _beginning(names: Callable[[Any], Iterable[str]]) -> Complete:
    def complete(ctx: Any, incomplete: str) -> list[str]:
        try:
            return sorted(name for name in names(ctx) if name.startswith(incomplete))
        except (SemstabError, OSError):
            return []  # what is wrong is said when the command runs

    return complete


def _backends(_: Any) -> Iterable[str]:
    from semstab import backends

    return backends.REGISTRY.entries()


def _datasets(_: Any) -> Iterable[str]:
    from semstab import datasets

    return datasets.REGISTRY.entries()


def _models(_: Any) -> Iterable[str]:
    from semstab import backbones

    return backbones.REGISTRY.entries()


def _filters(_: Any) -> Iterable[str]:
    from semstab.predict.filters import REGISTRY

    return REGISTRY.entries()


def _taxonomies(_: Any) -> Iterable[str]:
    from semstab.model.labels import shipped_taxonomies

    return shipped_taxonomies()


def _studies(_: Any) -> Iterable[str]:
    from semstab.settings import shipped_studies

    return shipped_studies()


def _opened(ctx: Any) -> Any:
    """The dataset that the options before select."""
    from semstab.datasets import open_dataset
    from semstab.settings import load_config, resolve

    data, name = ctx.params.get("data"), ctx.params.get("dataset")
    dataset = {"name": name or ("posed_folder" if data else None), "options": {"root": str(data)} if data else None}
    said = {key: value for key, value in dataset.items() if value is not None}
    config = resolve(load_config(ctx.params.get("config"), {"dataset": said} if said else {}))
    return open_dataset(config.dataset.name, config.dataset.options)


def _scenes(ctx: Any) -> Iterable[str]:
    return [*_opened(ctx).scenes, "all"]


def _sources(ctx: Any) -> Iterable[str]:
    opened = _opened(ctx)
    scenes = [opened.scene(name) for name in opened.scenes[:1]]
    return [*(name for scene in scenes for name in scene.backbones), "gt", "all"]


backends, datasets, models = _beginning(_backends), _beginning(_datasets), _beginning(_models)
filters = _beginning(_filters)
taxonomies, studies = _beginning(_taxonomies), _beginning(_studies)
scenes, label_sources = _beginning(_scenes), _beginning(_sources)
