"""The notebook of the documentation, run as it stands; a refreshed copy: `python tests/docs/test_notebook.py`."""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

import nbclient
import nbformat
import pytest

NOTEBOOK = Path(__file__).parents[2] / "docs/tutorials/decision.ipynb"
PICTURE = re.compile(r'src="data:image/png;base64,[^"]*"')


COARSE = "from semstab.report.figures import style; style.DPI = 60"
"""Run before its cells: pictures are compared by nobody."""


def executed(folder: Path):
    """The notebook, run in a folder; it uses the `semstab-bench` of this Python."""
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    os.environ["COLUMNS"] = "100"
    notebook = nbformat.read(NOTEBOOK, nbformat.NO_CONVERT)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(folder)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        for output in cell.get("outputs", ()):
            if "text/html" in output.get("data", {}):
                output["data"].pop("text/plain", None)
    return notebook


def texts_of_cells(notebook) -> list[str]:
    """What the cells show, without pictures."""
    texts = []
    for cell in notebook.cells:
        outputs = cell.get("outputs", ())
        # A cell's printed text arrives in pieces, as many as the pipe makes of it.
        texts.append("".join(output["text"] for output in outputs if output.output_type == "stream"))
        texts += [
            output["data"].get("text/html", output["data"].get("text/markdown"))
            for output in outputs
            if output.output_type != "stream"
        ]
    return [PICTURE.sub("", text).strip() for text in texts if text]


@pytest.mark.filterwarnings("ignore::DeprecationWarning:zmq", "ignore::RuntimeWarning:zmq")
def test_the_notebook_says_what_it_says_in_the_documentation(tmp_path, tmp_path_factory, monkeypatch):
    monkeypatch.setenv("PATH", os.environ["PATH"])
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path_factory.mktemp("ipython")))
    startup = Path(os.environ["IPYTHONDIR"]) / "profile_default/startup"
    startup.mkdir(parents=True)
    (startup / "coarse.py").write_text(COARSE)
    stored = nbformat.read(NOTEBOOK, nbformat.NO_CONVERT)
    assert len(stored.cells) <= 12
    again = texts_of_cells(executed(tmp_path))
    assert again == texts_of_cells(stored)
    assert "the gate passes" in "".join(again)
    assert "<table>" in again[0]


if __name__ == "__main__":
    where = Path(tempfile.mkdtemp())
    nbformat.write(executed(where), NOTEBOOK)
    shutil.rmtree(where)
