"""Fixtures for all tests."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
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


_VALIDATE = """
const { validateBytes } = require("gltf-validator"), { readFileSync } = require("fs");
Promise.all(process.argv.slice(1).map(f => validateBytes(new Uint8Array(readFileSync(f)))))
  .then(reports => console.log(JSON.stringify(reports.map(r => r.issues.messages))));
"""


@pytest.fixture(scope="session")
def gltf_issues() -> Callable[[Path], dict[str, list[tuple[int, str]]]]:
    """What the Khronos validator says of each GLB file in a folder: severity, 0 for an error to 3
    for a hint, and code. It is the package gltf-validator of node, in NODE_PATH or installed by
    npm install -g gltf-validator."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None:
        pytest.skip("needs node and its package gltf-validator")
    places = [os.environ.get("NODE_PATH", "")]
    if npm is not None:
        found = subprocess.run([npm, "root", "-g"], capture_output=True, text=True)
        places.append(found.stdout.strip())
    environment = {**os.environ, "NODE_PATH": os.pathsep.join(filter(None, places))}
    asked = [node, "-p", "require.resolve('gltf-validator')"]
    if subprocess.run(asked, env=environment, capture_output=True).returncode:
        pytest.skip("needs node's package gltf-validator: npm install -g gltf-validator")

    def issues(folder: Path) -> dict[str, list[tuple[int, str]]]:
        files = sorted(folder.rglob("*.glb"))
        assert files, f"no GLB file in {folder}"
        run = [node, "-e", _VALIDATE, *map(str, files)]
        text = subprocess.run(run, env=environment, capture_output=True, check=True).stdout
        return {
            str(file.relative_to(folder)): [(m["severity"], m["code"]) for m in messages]
            for file, messages in zip(files, json.loads(text), strict=True)
        }

    return issues


@pytest.fixture(scope="session")
def valid_gltf(gltf_issues) -> Callable[[Path], set[str]]:
    """Check that the validator says nothing of the GLB files in a folder; gives their names."""

    def check(folder: Path) -> set[str]:
        found = gltf_issues(folder)
        assert not {name: of for name, of in found.items() if of}
        return set(found)

    return check


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
