"""The wheel carries the configuration and runs from anywhere."""

import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """An environment that has only the wheel; dependencies come from the current environment."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder)]
    built = subprocess.run([*build, str(ROOT)], capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    wheel = next(folder.glob("*.whl"))
    environment = folder / "env"
    venv.create(environment, with_pip=False)
    python = environment / "bin" / "python"
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    site = environment / "lib" / version / "site-packages"
    pip = [sys.executable, "-m", "pip", "--quiet", "install", "--no-deps", "--target", str(site)]
    result = subprocess.run([*pip, str(wheel)], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    dependencies = [p for p in sys.path if p.endswith("site-packages")]
    (site / "dependencies.pth").write_text("\n".join(dependencies))
    return python


def test_it_runs_from_another_folder(installed, tmp_path):
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    environment["NSM_CACHE"] = str(tmp_path / "cache")
    where = subprocess.run(
        [installed, "-c", "import nsm.config; print(nsm.config.conf_folder())"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert str(ROOT) not in where.stdout, "the clone was imported instead of the wheel"
    assert Path(where.stdout.strip()).name == "conf"
    settings = ["surface=hemisphere", "experiment=quick", "trainer.max_steps=5", "logger=none"]
    settings += ["data.held_out=512", "artefacts=false"]
    result = subprocess.run(
        [installed, "-m", "nsm.cli", *settings],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    assert len(list((tmp_path / "outputs" / "overfit").glob("hemisphere-*/metrics.json"))) == 1
    report = subprocess.run(
        [installed, "-m", "nsm.cli", "report", "outputs"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert report.returncode == 0, report.stderr
    assert (tmp_path / "report.html").stat().st_size > 1_000_000
