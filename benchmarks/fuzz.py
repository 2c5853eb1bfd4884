"""Fuzz the readers of files, guided by coverage: ``make fuzz``.

Each target reads bytes that are mutated from seeds and from the cases in tests/corpus, and may
raise only NsmError. Input that raises anything else is stored in the folder ``crashes``; once the
defect is fixed, the file belongs into tests/corpus, whose files tests/test_corpus.py reads again.

    python benchmarks/fuzz.py TARGET [SECONDS]
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import atheris

os.environ["NUMBA_DISABLE_JIT"] = "1"  # what is instrumented cannot be compiled
ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "benchmarks")]

with atheris.instrument_imports(include=["nsm", "plyfile", "trimesh"]):
    import corpus_targets
    from torture.files import exported
    from torture.shapes import tetrahedron


def main() -> None:
    name = sys.argv[1]
    seconds = sys.argv[2] if len(sys.argv) > 2 else "60"
    target = corpus_targets.TARGETS[name]
    crashes = ROOT / "crashes"
    crashes.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as seeds:
        if name in corpus_targets.MESHES:
            forms = {"ply": ("ply", "binary.ply"), "stl": ("stl", "binary.stl")}.get(name, (name,))
            for form in forms:
                (Path(seeds) / form).write_bytes(exported(tetrahedron(), form))
        elif name == "config":
            (Path(seeds) / "config").write_bytes((ROOT / "conf" / "config.yaml").read_bytes())
        for k, data in enumerate(corpus_targets.seeds(name)):
            (Path(seeds) / f"seed{k}").write_bytes(data)
        for file in (ROOT / "tests" / "corpus" / name).glob("*"):
            (Path(seeds) / file.name).write_bytes(file.read_bytes())
        atheris.Setup(
            [
                sys.argv[0],
                seeds,
                f"-max_total_time={seconds}",
                f"-artifact_prefix={crashes}/{name}-",
                "-max_len=16384",
                "-timeout=20",
                "-rss_limit_mb=3000",
            ],
            target,
        )
        atheris.Fuzz()


if __name__ == "__main__":
    main()
