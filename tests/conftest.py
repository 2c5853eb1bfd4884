"""Fixtures for all tests."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from nsm import cli


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """Tests neither read nor fill the user's cache."""
    before = os.environ.get("NSM_CACHE")
    os.environ["NSM_CACHE"] = str(tmp_path_factory.mktemp("cache"))
    yield
    if before is None:
        del os.environ["NSM_CACHE"]
    else:
        os.environ["NSM_CACHE"] = before


@pytest.fixture(scope="session")
def shared_meshes() -> Path:
    """A folder with the classic models: NSM_MESHES, or shared/meshes beside the clone."""
    folder = Path(
        os.environ.get("NSM_MESHES", Path(__file__).parent.parent.parent / "shared" / "meshes")
    )
    if not folder.is_dir():
        pytest.skip("no folder of classic models; set NSM_MESHES to one")
    return folder


@pytest.fixture
def here(tmp_path, monkeypatch, capfd):
    """Run the command within this process, in a temporary folder: imports take seconds."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NSM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(sys, "path", [*sys.path])  # the command adds its folder

    def call(*arguments: str) -> subprocess.CompletedProcess:
        monkeypatch.setattr(sys, "argv", ["nsm", *arguments])
        status = 0
        try:
            cli.main()
        except SystemExit as stop:
            status = int(stop.code or 0)
        out, err = capfd.readouterr()
        return subprocess.CompletedProcess(arguments, status, out, err)

    return call
