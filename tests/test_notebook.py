"""The notebook of the documentation runs from top to bottom, in a kernel of its own."""

import os
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parent.parent / "docs" / "notebook.ipynb"


def test_the_notebook_runs_and_is_stored_without_output(tmp_path, monkeypatch):
    nbformat = pytest.importorskip("nbformat", reason="needs nsm[dev]")
    nbclient = pytest.importorskip("nbclient", reason="needs nsm[dev]")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(NOTEBOOK.parent.parent)]))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=300, resources=resources).execute()
    outputs = [cell.outputs for cell in notebook.cells if cell.cell_type == "code"]
    assert not [o.text for of_one in outputs for o in of_one if o.get("name") == "stderr"]
    certificate = next(
        o.data["text/plain"] for o in outputs[3] if o.output_type == "execute_result"
    )
    assert "'certified': True" in certificate
    assert float(outputs[4][0].text) < 1e-6  # correspondences are the map's images
    assert any("image/png" in o.get("data", {}) for o in outputs[5])
    assert (tmp_path / "hill.glb").exists() and (tmp_path / "hill_map" / "pair.json").exists()
