"""The report: its content compared with the runs, and the page in a browser."""

import base64
import csv
import gzip
import io
import json
import re
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import headless
from omegaconf import OmegaConf
from PIL import Image

from nsm.commands import report
from nsm.config import compose_config
from nsm.errors import NsmError
from nsm.pipeline import run
from nsm.results import load_surface
from nsm.results.metrics import evaluate
from nsm.results.report import write_report
from nsm.results.report.labels import labels, over_seeds
from nsm.results.report.runs import Run, find_runs
from nsm.results.report.sweep import write_sweep

TINY = [
    "surface=hemisphere",
    "experiment=quick",
    "data.batch_size=256",
    "data.steps_per_epoch=10",
    "data.held_out=256",
    "trainer.max_steps=20",
    "trainer.progress=false",
    "trainer.log_every=5",
    "trainer.log_pictures=0",
    "artefacts=false",
]
HOSTILE = "<img src=x onerror=window.pwned=1> %{x} <b>bold<"

TIMEOUT = 180  # seconds; drawing without a GPU is slow


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """A sweep of two overfits, a flattening and a map; interrupted, damaged and failed runs."""
    folder = tmp_path_factory.mktemp("runs")
    sweep = folder / "sweep"
    for name, activation in ((HOSTILE, "silu"), ("1", "relu")):
        run(compose_config([*TINY, f"activation={activation}"]), sweep / name)
    Image.fromarray(np.full((40, 60, 3), 90, np.uint8)).save(sweep / "1" / "error.png")
    ready = f"phi.path={sweep / '1'}"
    run(compose_config(["task=param", ready, *TINY, "baselines=true"]), folder / "flat")
    ends = [f"source={sweep / '1'}", "target=sphere_cap"]
    run(compose_config(["task=pair_map", *ends, *TINY]), folder / "map")
    shutil.copytree(sweep / "1", folder / "interrupted")
    (folder / "interrupted" / "metrics.json").unlink()
    shutil.copytree(sweep / "1", folder / "truncated")
    (folder / "truncated" / "metrics.json").write_text('{"steps": 20, "metri')
    (folder / "failed").mkdir()
    (folder / "failed" / "error.txt").write_text("Traceback\nValueError: <b>too much</b>\n")
    return folder


@pytest.fixture(scope="module")
def page(runs, tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("page") / "report.html"
    assert write_report([runs], file, f"Title {HOSTILE}") == (4, 3)
    return file


def content(page: Path) -> dict:
    packed = re.search(r'id="content">([^<]*)<', page.read_text()).group(1)
    return json.loads(gzip.decompress(base64.b64decode(packed)))


def task(page: Path, name: str) -> dict:
    return next(one for one in content(page)["tasks"] if one["name"] == name)


def unpacked(content: dict, index: int) -> np.ndarray:
    stored = content["arrays"][index]
    return np.frombuffer(base64.b64decode(stored["data"]), "<" + stored["type"])


def test_figures_and_settings_are_those_of_the_runs(runs, page):
    overfit = task(page, "overfit")
    assert overfit["differing"][0] == "activation"
    assert {one["label"] for one in overfit["runs"]} >= {
        "hemisphere, activation=silu",
        "hemisphere, activation=relu",
    }
    for one in overfit["runs"]:
        stored = json.loads((runs / one["name"] / "metrics.json").read_text())
        assert one["figures"].items() >= stored["metrics"].items()
        assert one["figures"]["steps"] == 20
    flat = task(page, "param")["runs"][0]["figures"]
    maps = json.loads((runs / "flat" / "metrics.json").read_text())["metrics"]
    ours = maps["nsm"]
    assert flat.pop("certified") == {True: "yes", False: "no"}[ours.pop("certified")]
    assert flat.items() >= ours.items()
    assert flat["SLIM (libigl): area_median"] == maps["SLIM (libigl)"]["area_median"]


def test_figures_of_a_collection_are_the_means_of_its_pairs(runs, tmp_path):
    shutil.copytree(runs / "sweep" / "1", tmp_path / "run")
    pairs = {
        "a → b": {"flipped_percent": 1.0, "injective": True, "area_mean": None},
        "b → a": {"flipped_percent": 3.0, "injective": False, "area_mean": 2.0},
    }
    metrics = {"pairs": pairs, "cycle_error_mean_percent": 0.5, "injective": False, "why": ["x"]}
    (tmp_path / "run" / "metrics.json").write_text(json.dumps({"steps": 5, "metrics": metrics}))
    write_report([tmp_path], tmp_path / "report.html")
    figures = task(tmp_path / "report.html", "overfit")["runs"][0]["figures"]
    assert figures == {
        "steps": 5,
        "flipped_percent": 2.0,
        "injective": "no",
        "area_mean": None,
        "cycle_error_mean_percent": 0.5,
        "a → b: flipped_percent": 1.0,
        "a → b: injective": "yes",
        "a → b: area_mean": None,
        "b → a: flipped_percent": 3.0,
        "b → a: injective": "no",
        "b → a: area_mean": 2.0,
    }


def test_curves_end_at_the_last_step(page):
    curves = task(page, "overfit")["runs"][0]["curves"]
    assert curves["val/rms_percent"]["steps"][-1] >= 19
    assert all(value > 0 for value in curves["train/loss"]["values"])
    assert curves["train/loss"]["seconds"][0] == 0
    assert not any(name.startswith("figures/") for name in curves)


def test_a_csv_log_gives_curves_too(runs, tmp_path):
    shutil.copytree(runs / "sweep" / "1", tmp_path / "run")
    log = "epoch,step,val/own\n0,0,3.5\n0,10,\n0,20,nan\n0,30,1.5\n"
    (tmp_path / "run" / "metrics.csv").write_text(log)
    write_report([tmp_path], tmp_path / "report.html")
    curve = task(tmp_path / "report.html", "overfit")["runs"][0]["curves"]["val/own"]
    assert (curve["steps"], curve["values"]) == ([0, 20, 30], [3.5, None, 1.5])


def test_histograms_are_the_distortion_of_the_triangles(runs, page):
    overfit = task(page, "overfit")
    number = [one["name"] for one in overfit["runs"]].index("sweep/1")
    phi = load_surface(runs / "sweep" / "1")
    image, values, areas = evaluate(phi.map, phi.surface.uv), [], []
    for corners in phi.surface.faces:
        x, y = phi.surface.vertices[corners], image[corners]
        e, g = np.stack([x[1] - x[0], x[2] - x[0]], 1), np.stack([y[1] - y[0], y[2] - y[0]], 1)
        q, r = np.linalg.qr(e)
        sigma = np.linalg.svd(g @ np.linalg.inv(r), compute_uv=False)
        values.append((sigma**2).sum() + (1 / (sigma**2 + 0.01)).sum())
        areas.append(abs(np.linalg.det(r)))
    values, areas = np.array(values), np.array(areas)
    shown = next(one for one in overfit["histograms"] if one["name"] == "symmetric dirichlet")
    shares, edges = np.array(shown["shares"][number]), np.array(shown["edges"])
    assert shares.sum() == pytest.approx(100, abs=0.1)
    for k in (15, 30, 45):
        below = 100 * areas[values < edges[k]].sum() / areas.sum()
        assert shares[:k].sum() == pytest.approx(below, abs=0.2)


def test_shapes_are_those_of_the_runs_and_shared_arrays_are_stored_once(runs, page):
    shown = content(page)
    overfit = next(one for one in shown["tasks"] if one["name"] == "overfit")
    for one in overfit["runs"]:
        phi = load_surface(runs / one["name"])
        shape = one["shapes"][0]
        vertices = unpacked(shown, shape["vertices"]).reshape(-1, 3)
        assert np.allclose(vertices, evaluate(phi.map, phi.surface.uv), atol=1e-5)
        assert np.array_equal(unpacked(shown, shape["faces"]).reshape(-1, 3), phi.surface.faces)
    assert len({one["shapes"][0]["faces"] for one in overfit["runs"]}) == 1
    mapped = next(one for one in shown["tasks"] if one["name"] == "pair_map")["runs"][0]
    assert [shape["name"] for shape in mapped["shapes"]] == ["mapped onto the target", "source"]


def test_incomplete_and_damaged_runs_are_listed(runs, page, tmp_path):
    reasons = {item["name"]: item["reason"] for item in content(page)["incomplete"]}
    assert "not finished" in reasons["interrupted"]
    assert "metrics.json is damaged" in reasons["truncated"]
    assert reasons["failed"] == "failed: ValueError: <b>too much</b>"
    bad = tmp_path / "bad"
    shutil.copytree(runs / "sweep" / "1", bad)
    (bad / "surface.safetensors").write_bytes(b"short")
    (bad / "error.png").write_bytes(b"\x89PNG")
    next((bad / "tensorboard").glob("events*")).write_bytes(b"noise" * 100)
    (bad / "metrics.csv").write_text("step,x\nten,1\n")
    shutil.copytree(runs / "sweep" / "1", tmp_path / "worse")
    (tmp_path / "worse" / "config.yaml").write_text("a: [")
    write_report([tmp_path], tmp_path / "report.html")
    shown = content(tmp_path / "report.html")
    lines = [f"{item['name']}: {item['reason']}" for item in shown["incomplete"]]
    for part in ("surface.safetensors", "error.png", "metrics.csv", "worse: config.yaml"):
        assert any(part in line for line in lines), part
    assert [one["name"] for one in shown["tasks"][0]["runs"]] == ["bad"]


def test_a_fine_mesh_is_decimated_for_the_page(runs, monkeypatch, tmp_path):
    monkeypatch.setattr("nsm.results.report.shapes._FACES", 100)
    write_report([runs / "sweep" / "1"], tmp_path / "report.html")
    shown = content(tmp_path / "report.html")
    phi = load_surface(runs / "sweep" / "1")
    shape = shown["tasks"][0]["runs"][0]["shapes"][0]
    vertices = unpacked(shown, shape["vertices"]).reshape(-1, 3)
    faces = unpacked(shown, shape["faces"]).reshape(-1, 3)
    assert 50 < len(faces) <= 100 < len(phi.surface.faces)
    known = evaluate(phi.map, phi.surface.uv)
    assert all(np.abs(known - vertex).max(axis=1).min() < 1e-5 for vertex in vertices[::7])
    for colour in shape["colours"].values():
        count = len(faces) if colour["of"] == "faces" else len(vertices)
        assert len(unpacked(shown, colour["values"])) == count


@pytest.mark.parametrize(
    ("folder", "output", "error"),
    [
        ("nowhere", "report.html", ("missing_folder", "nowhere")),
        ("empty", "report.html", ("no_runs", "empty")),
        ("empty", "nowhere/report.html", ("missing_folder", "nowhere/report.html")),
        ("empty", "empty", ("not_a_file", "empty")),
    ],
)
def test_wrong_folders_and_outputs(tmp_path, monkeypatch, folder, output, error):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(NsmError) as caught:
        write_report([Path(folder)], Path(output))
    assert (caught.value.kind, caught.value.key) == error
    assert list(tmp_path.rglob("*.html")) == []


@pytest.mark.parametrize("words", [[], ["nowhere"], ["nowhere", "--outptu=x"]])
def test_wrong_words_are_one_line_and_status_2(here, words):
    result = here("report", *words)
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1


def test_trusted_modules_reach_the_loaders(runs, tmp_path, monkeypatch):
    given = []

    def load(folder, trust=()):
        given.append(list(trust))
        raise NsmError("not loaded")

    monkeypatch.setattr("nsm.results.report.shapes.load_surface", load)
    output = tmp_path / "report.html"
    report.main([str(runs / "sweep" / "1"), "-o", str(output), "--trust=a", "--trust", "b.c, d"])
    assert given == [["a", "b.c", "d"]]
    assert [item["reason"] for item in content(output)["incomplete"]] != []


def test_settings_are_named_by_their_group(runs, tmp_path):
    """The class of a group stands for the group, and its parameters are left out of labels."""
    targets = {"1": ("nsm.maps.activations.Softplus", 10.0), "2": ("mine.Bump", 3.0)}
    for name, (target, beta) in targets.items():
        shutil.copytree(runs / "sweep" / "1", tmp_path / name)
        config = {
            "task": {"_target_": "nsm.pipeline.overfit.OverfitTask", "name": "overfit"},
            "activation": {"_target_": target, "beta": beta},
            "optimizer": {"lr": 0.1},
        }
        (tmp_path / name / "config.yaml").write_text(json.dumps(config))
    write_report([tmp_path], tmp_path / "report.html")
    shown = task(tmp_path / "report.html", "overfit")
    assert shown["differing"] == ["activation", "activation.beta"]
    assert [one["label"] for one in shown["runs"]] == [
        "hemisphere, activation=softplus",
        "hemisphere, activation=mine.Bump",
    ]
    assert shown["runs"][0]["settings"]["optimizer.lr"] == 0.1


def written(folder: Path, **settings: Any) -> None:
    """A run of hand-made settings and figures."""
    figures = settings.pop("figures")
    folder.mkdir(parents=True)
    config = {"task": {"_target_": "nsm.pipeline.overfit.OverfitTask", "name": "overfit"}}
    (folder / "config.yaml").write_text(json.dumps(config | settings))
    (folder / "metrics.json").write_text(json.dumps(figures))


def test_figures_over_seeds_are_means_and_deviations(tmp_path):
    for width in (32, 64):
        for seed in (0, 1, 2):
            error = {32: [1.0, 2.0, 4.5], 64: [3.0, 3.0, 3.0]}[width][seed]
            figures = {"surface": "cow", "metrics": {"rms_percent": error, "certified": True}}
            written(tmp_path / f"{width}-{seed}", map={"width": width}, seed=seed, figures=figures)
    written(tmp_path / "alone", map={"width": 8}, seed=0, figures=figures)
    runs, _ = find_runs([tmp_path])
    few, many = over_seeds(runs)
    assert (few.label, many.label) == ("cow, width=32", "cow, width=64")
    assert [runs[n].settings["map.width"] for n in few.runs] == [32, 32, 32]
    assert few.figures == {"rms_percent": pytest.approx((2.5, np.sqrt(3.25)))}
    assert many.figures == {"rms_percent": (3.0, 0.0)}


def test_runs_are_named_by_what_they_are_of(tmp_path):
    kinds = {
        "a": {"surface": "cat", "target": "horse"},
        "b": {"surface": "cat", "surfaces": list("uvwxyz")},
        "c": {"surface": "cow"},
        "d": {"surface": "cow"},
    }
    for name, kind in kinds.items():
        written(tmp_path / name, figures={**kind, "metrics": {"rms_percent": 1.0}})
    runs, _ = find_runs([tmp_path])
    assert labels(runs) == ["cat → horse", "u, v, w, x, 2 more", "cow (c)", "cow (d)"]


def test_the_page_has_the_axis_of_the_runs_upwards(tmp_path):
    for name, axis in (("a", "-z"), ("b", "-z"), ("c", "nonsense")):
        written(tmp_path / name, up=axis, figures={"surface": "cow", "metrics": {}})
    write_report([tmp_path], tmp_path / "report.html")
    assert content(tmp_path / "report.html")["up"] == "-z"
    write_report([tmp_path], tmp_path / "report.html", up="x")
    assert content(tmp_path / "report.html")["up"] == "x"


def test_jobs_are_called_by_the_settings_that_tell_them_apart():
    def told(*jobs):
        runs = [Run(Path("x"), str(k), "overfit", "", one, {}) for k, one in enumerate(jobs)]
        return labels(runs)

    # options, each with its parameters
    softplus = {"activation": "softplus", "activation.beta": 10.0}
    assert told(softplus, {"activation": "relu"}) == ["activation=softplus", "activation=relu"]
    # parameters of one class, which are those of an option by chance
    wide = {"map": "mlp", "map.width": 64, "map.depth": 4}
    deep = {"map": "NeuralMap", "map.width": 64, "map.depth": 1}
    thin = {"map": "NeuralMap", "map.width": 32, "map.depth": 1}
    names = ["width=64, depth=4", "width=64, depth=1", "width=32, depth=1"]
    assert told(wide, deep, thin) == names
    # neither follows from the other
    rates = [{"optimizer": n, "optimizer.lr": r} for n in ("Adam", "SGD") for r in (0.1, 0.2)]
    assert told(*rates)[0] == "optimizer=Adam, lr=0.1"
    assert len(set(told(*rates))) == 4


def test_a_sweep_ends_with_a_figure_and_a_table_that_the_report_shows(runs, tmp_path):
    sweep = tmp_path / "sweep-activation"
    for name in ("1", HOSTILE):
        shutil.copytree(runs / "sweep" / name, sweep / str(len(name)))
    table = write_sweep(sweep)
    names = ["hemisphere, activation=relu", "hemisphere, activation=silu"]
    # what all jobs are of stands above the table
    assert [f"{table.title}, {cell}" for cell in table.columns[0].cells] == names
    with (sweep / "sweep.csv").open() as stream:
        rows = {row["job"]: row for row in csv.DictReader(stream)}
    assert set(rows) == set(names)
    for row in rows.values():
        stored = json.loads((sweep / row["folder"] / "metrics.json").read_text())["metrics"]
        assert float(row["rms_percent"]) == stored["rms_percent"]
    picture = np.asarray(Image.open(sweep / "sweep.png").convert("RGB"), dtype=float)
    assert np.ptp(picture, axis=2).max() > 100  # colours of normals
    write_report([sweep], tmp_path / "report.html")
    (shown,) = content(tmp_path / "report.html")["sweeps"]
    assert shown["name"] == "sweep-activation"
    data = base64.b64decode(shown["picture"].split(",")[1])
    assert Image.open(io.BytesIO(data)).width >= 900


def test_a_sweep_of_the_seams_weight_shows_the_gap_and_the_landmarks(runs, tmp_path):
    gaps = {"0": 1.25, "1000": 0.125}
    for weight, gap in gaps.items():
        job = tmp_path / weight
        shutil.copytree(runs / "map", job)
        config = OmegaConf.load(job / "config.yaml")
        config.loss_weights.seam = float(weight)
        OmegaConf.save(config, job / "config.yaml")
        stored = json.loads((job / "metrics.json").read_text())
        stored["metrics"] |= {"seam_gap_mean_percent": gap, "landmark_error_max_percent": 2 * gap}
        (job / "metrics.json").write_text(json.dumps(stored))
    table = write_sweep(tmp_path, figure=False)
    cells = {str(column.header): list(column.cells) for column in table.columns}
    assert cells["job"] == ["seam=0.0", "seam=1000.0"]
    (gap,) = (shown for name, shown in cells.items() if "seam" in name)
    (marks,) = (shown for name, shown in cells.items() if "landmark" in name)
    assert gap == ["1.250", "0.125"] and marks == ["2.500", "0.250"]


def test_a_view_is_upright_for_any_axis(page):
    for axis, frame in task(page, "overfit")["runs"][0]["shapes"][0]["frames"].items():
        sign = -1 if axis[0] == "-" else 1
        assert sign * frame["up"]["xyz".index(axis[-1])] > 0.5
        assert np.dot(frame["up"], frame["towards"]) == pytest.approx(0, abs=1e-4)


def test_the_command_writes_the_page_and_prints_its_path(runs, tmp_path, here):
    result = here("report", str(runs / "sweep" / "1"))
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "1 run: report.html"
    assert (tmp_path / "report.html").stat().st_size > 1_000_000


# ---- in a browser


@pytest.fixture(scope="module")
def browser(page):
    """Headless Chromium with the page in it."""
    logs = {"browser": "ALL", "performance": "ALL"}
    with headless(1400, 1000, ["disable-gpu", "disable-quic"], logs) as window:
        window.set_script_timeout(TIMEOUT)
        window.get(page.as_uri())
        until(window, "return document.documentElement.dataset.state === 'ready'")
        click(window, "#tasks button[data-name=overfit]")
        yield window


def until(window, question: str) -> None:
    start = time.monotonic()
    while not window.execute_script(question):
        assert time.monotonic() - start < TIMEOUT, question
        time.sleep(0.1)


def click(window, selector: str) -> None:
    window.execute_script("document.querySelector(arguments[0]).click()", selector)


def type_into(window, selector: str, text: str) -> None:
    window.execute_script(
        "const field = document.querySelector(arguments[0]); field.value = arguments[1];"
        "field.dispatchEvent(new Event('input'))",
        selector,
        text,
    )


def names(window) -> list[str]:
    rows = "#table tbody tr:not(.details) td.first button"
    return window.execute_script(
        "return [...document.querySelectorAll(arguments[0])].map(x => x.textContent)", rows
    )


def test_the_page_loads_nothing_and_logs_no_errors(browser, page):
    until(browser, "return document.querySelectorAll('#shapes canvas').length >= 2")
    log = [json.loads(line["message"])["message"] for line in browser.get_log("performance")]
    asked = [
        entry["params"]["request"]["url"]
        for entry in log
        if entry["method"] == "Network.requestWillBeSent"
        and entry["params"].get("documentURL", "").startswith("file:")
    ]
    assert page.as_uri() in asked
    assert {url.split(":")[0] for url in asked} <= {"file", "data", "blob"}
    assert [url for url in asked if url.startswith("file:")] == [page.as_uri()]
    assert [line for line in browser.get_log("browser") if line["level"] == "SEVERE"] == []


def test_names_from_files_do_not_become_markup(browser, page):
    assert HOSTILE not in page.read_text()
    assert browser.execute_script("return window.pwned") is None
    assert browser.execute_script("return document.querySelectorAll('img[src=x], b').length") == 0
    title = browser.execute_script("return document.querySelector('h1').textContent")
    assert title == f"Title {HOSTILE}" == browser.title


def test_the_table_sorts_and_filters(browser):
    key = "th[data-key=rms_percent] button"
    cells = "#table tbody tr td:nth-child(n)"
    assert browser.execute_script(f"return document.querySelectorAll('{cells}').length") > 10
    click(browser, key)
    rising = names(browser)
    click(browser, key)
    assert names(browser) == rising[::-1]
    assert set(rising) == {"hemisphere, activation=silu", "hemisphere, activation=relu"}
    click(browser, key)
    type_into(browser, "thead input[aria-label='filter activation']", "RELU")
    assert names(browser) == ["hemisphere, activation=relu"]
    # filters apply to the plots as well
    plotted = "return document.querySelector('#curves .plot').data.map(x => x.name)"
    assert browser.execute_script(plotted) == ["hemisphere, activation=relu"]
    type_into(browser, "thead input[aria-label='filter activation']", "")
    type_into(browser, "thead input[aria-label='filter RMS distance']", "< 0")
    assert names(browser) == []
    type_into(browser, "thead input[aria-label='filter RMS distance']", ">= 0")
    assert len(names(browser)) == 2
    type_into(browser, "thead input[aria-label='filter RMS distance']", "")
    click(browser, "#table tbody input[type=checkbox]")
    assert len(browser.execute_script(plotted)) == 1
    click(browser, "#table tbody input[type=checkbox]")
    assert len(browser.execute_script(plotted)) == 2


def test_the_first_curve_is_of_held_out_points_and_has_several(browser):
    chosen = browser.execute_script("return document.querySelector('#curves select').value")
    assert chosen == "val/rms_percent"
    counts = "return document.querySelector('#curves .plot').data.map(x => x.x.length)"
    assert browser.execute_script(counts) == [2, 2]


def test_a_picture_is_large_on_a_click(browser):
    click(browser, "#pictures img")
    assert browser.execute_script("return document.querySelector('#large').open")
    width = "return document.querySelector('#large img').getBoundingClientRect().width"
    assert browser.execute_script(width) > 1200
    click(browser, "#large")


def test_views_show_shapes_and_rotate_together(browser):
    until(browser, "return document.querySelectorAll('#shapes canvas').length >= 2")
    view = browser.find_element("css selector", "#shapes .view")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", view)
    time.sleep(1)
    before = picture(view)
    assert before.std() > 15, "an empty view"
    browser.execute_script(
        "Plotly.relayout(document.querySelector('#shapes .view'),"
        "{'scene.camera': {eye: {x: 0, y: 0.1, z: -2}, up: {x: 0, y: 1, z: 0}}})"
    )
    until(
        browser,
        "return [...document.querySelectorAll('#shapes .view')]"
        ".every(v => v.layout.scene.camera.eye.z === -2)",
    )
    time.sleep(1)
    assert np.abs(picture(view) - before).mean() > 2


def picture(element) -> np.ndarray:
    image = Image.open(io.BytesIO(element.screenshot_as_png)).convert("L")
    return np.asarray(image, dtype=float)


def test_other_tasks_and_damaged_runs_are_on_the_page(browser):
    click(browser, "#tasks button[data-name=param]")
    until(browser, "return document.querySelectorAll('#shapes .view').length === 1")
    shapes = "return [...document.querySelectorAll('#shapes select')[0].options].map(x => x.value)"
    assert browser.execute_script(shapes) == ["flattened", "surface"]
    listed = browser.execute_script("return document.querySelector('#incomplete').innerText")
    assert "interrupted" in listed and "truncated" in listed
    click(browser, "#tasks button[data-name=overfit]")
