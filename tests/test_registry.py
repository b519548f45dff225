import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest

from semstab import backends
from semstab.core import registry
from semstab.core.registry import Registration, Registry
from semstab.errors import ConfigError, MissingDependencyError

SHAPES = Registry(
    "shape",
    {
        "fraction": Registration("fractions:Fraction", "in the standard library"),
        "engine": Registration("semstab_no_such_engine:Engine", "", "pip install the-engine"),
        "bare": Registration("semstab_no_such_engine:Engine", ""),
    },
)


def test_a_name_gives_its_class():
    from fractions import Fraction

    assert SHAPES.load("fraction") is Fraction


def test_an_unknown_name_gets_the_nearest_known_one():
    with pytest.raises(ConfigError, match=r"^backend 'open3' is not known; did you mean 'open3d'\?$"):
        backends.create("open3", voxel_size=0.2, num_classes=3)


def test_a_name_like_no_other_gets_them_all():
    with pytest.raises(ConfigError, match=r"^shape 'xyz' is not known; known: bare, engine, fraction$"):
        SHAPES.load("xyz")


def test_a_missing_package_says_how_to_install_it():
    with pytest.raises(MissingDependencyError, match=r"^shape 'engine' cannot be used \(.*\); pip install the-engine$"):
        SHAPES.load("engine")
    with pytest.raises(MissingDependencyError, match=r"No module named .*; install the packages that it needs$"):
        SHAPES.load("bare")


@pytest.mark.parametrize(
    "error",
    [
        OSError("libGL.so.1: cannot open shared object file:\nNo such file"),
        RuntimeError("operator torchvision::nms does not exist"),  # of packages that do not fit each other
        ValueError("numpy.dtype size changed"),
    ],
)
def test_an_import_that_fails_inside_is_a_missing_dependency(monkeypatch, error):
    def import_module(name):
        raise error

    monkeypatch.setattr(registry.importlib, "import_module", import_module)
    with pytest.raises(
        MissingDependencyError, match=r"^shape 'engine' cannot[^\n]*; pip install the-engine$"
    ) as caught:
        SHAPES.load("engine")
    assert str(error).splitlines()[0] in str(caught.value)


def test_the_list_says_what_is_not_ready(monkeypatch, capsys):
    from semstab import models
    from semstab.cli.show_commands import list_

    original = registry.importlib.import_module

    def import_module(name, package=None):
        if name.startswith(("semstab.backends", "semstab.models")):
            raise RuntimeError("operator torchvision::nms does not exist")
        return original(name, package)

    monkeypatch.setattr(registry.importlib, "import_module", import_module)
    monkeypatch.setenv("COLUMNS", "300")
    assert "sam-raw" in models.REGISTRY.entries()
    list_(check=True)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "sam-raw" in line]
    assert "torchvision::nms does not exist" in line


def test_the_list_names_packages_that_are_not_installed(monkeypatch, capsys):
    from semstab.cli.show_commands import list_

    found = registry.importlib.util.find_spec
    monkeypatch.setattr(registry.importlib.util, "find_spec", lambda name: None if name == "torch" else found(name))
    monkeypatch.setenv("COLUMNS", "300")
    list_()
    lines = capsys.readouterr().out.splitlines()
    (line,) = [line for line in lines if "sam-raw" in line]
    assert line.split(maxsplit=1)[1].startswith("pip install 'semstab[sam]' (torch: not installed")


def test_the_list_imports_no_engine():
    heavy = "open3d", "torch", "transformers", "rerun", "numba"
    code = "from semstab.cli.show_commands import list_; list_(); import sys; print({*sys.argv} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code, *heavy], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "set()"


@pytest.fixture
def shapes(monkeypatch):
    """A registry to which another package adds by entry points."""
    declared = [
        EntryPoint("ratio", "fractions:Fraction", "semstab.shapes"),
        EntryPoint("engine", "fractions:Fraction", "semstab.shapes"),
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: [p for p in declared if p.group == group])
    return Registry(SHAPES.kind, SHAPES.builtin)


def test_other_packages_add_names(shapes):
    from fractions import Fraction

    assert shapes.load("ratio") is Fraction
    assert shapes.entry("ratio").summary == "from the package fractions"
    assert "ratio" not in Registry("backend", {}).entries()


def test_other_packages_do_not_replace_names(shapes):
    assert shapes.entry("engine").install == "pip install the-engine"


def test_the_package_imports_nothing_heavy():
    heavy = ("numpy", "open3d", "rerun", "matplotlib", "pydantic", "pyarrow", "cv2", "trimesh", "yaml")
    code = f"import sys, semstab; print([name for name in {heavy} if name in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "module", ["semstab.backends", "semstab.data.frames", "semstab.metrics", "semstab.data.voxels"]
)
def test_the_data_model_needs_numpy_alone(module):
    heavy = ("open3d", "rerun", "matplotlib", "pyarrow", "cv2", "trimesh", "hypothesis", "pytest")
    code = f"import sys, {module}; print([name for name in {heavy} if name in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_public_names_are_all_there():
    import semstab

    assert all(hasattr(semstab, name) for name in semstab.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        semstab.nonsense  # noqa: B018
