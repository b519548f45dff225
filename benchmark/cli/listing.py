"""The command list."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from semstab.runtime.registry import Registry


def list_() -> None:
    """Backends, datasets, backbones, filters, taxonomies and studies, each with 'ready' or what to install."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from semstab import backbones, backends, datasets
    from semstab.model.labels import LabelSpace, shipped_taxonomies
    from semstab.predict import filters
    from semstab.settings import load_study, shipped_studies

    table = Table(show_edge=False)
    for name in ("kind", "name", "", "what it is"):
        table.add_column(name)
    for registry in (backends.REGISTRY, datasets.REGISTRY, backbones.REGISTRY, filters.REGISTRY):
        for name, entry in sorted(registry.entries().items()):
            table.add_row(registry.kind, name, _ready(registry, name), escape(entry.summary))
    for name in shipped_taxonomies():
        space = LabelSpace.load(name)
        table.add_row("taxonomy", name, "[green]ready", f"K = {len(space)}: {', '.join(space.classes)}")
    for name in shipped_studies():
        table.add_row("study", name, "[green]ready", load_study(name).description)
    Console().print(table)


def _ready(registry: Registry, name: str) -> str:
    """'ready', where what is behind the name really imports, or what to install."""
    from rich.markup import escape

    from semstab.errors import MissingDependencyError

    try:
        registry.load(name)
    except MissingDependencyError as error:
        return f"[yellow]{escape(str(error))}"
    return "[green]ready"
