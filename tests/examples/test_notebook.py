"""The notebook runs from its first cell to its last, where only the package is.

For `make test-examples`: the environment has the installed package and no checkout.
"""

import shutil
from pathlib import Path

import pytest
from PIL import Image

nbclient = pytest.importorskip("nbclient", reason="for `make test-examples`")
nbformat = pytest.importorskip("nbformat", reason="for `make test-examples`")

EXAMPLES = Path(__file__).parents[2] / "examples"
LIMIT_S = 600
"""Of a cell: the first ones of a new environment wait for loops to be compiled."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A copy of the examples, without the checkout around it."""
    copied = tmp_path / "examples"
    shutil.copytree(EXAMPLES, copied, ignore=shutil.ignore_patterns("out"))
    monkeypatch.delenv("PYTHONPATH", raising=False)
    return copied


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda p: p.stem)
def test_the_notebook_runs_and_makes_its_pictures(folder, path):
    notebook = nbformat.read(folder / path.name, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "kept outputs"
    client = nbclient.NotebookClient(
        notebook, timeout=LIMIT_S, resources={"metadata": {"path": str(folder)}}
    )
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    drawn = [output for output in outputs if "image/png" in output.get("data", ())]
    assert len(drawn) >= 3
    with Image.open(folder / "out" / "examples" / f"{path.stem}.png") as picture:
        assert min(picture.size) > 200
    imported = notebook.cells[1].source
    assert "from ocufilter import" in imported
