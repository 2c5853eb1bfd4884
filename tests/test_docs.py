"""The documentation builds, its code runs, its commands compose, its figures were measured."""

import itertools
import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from doc_pages import (
    PAGES,
    ROOT,
    blocks,
    commands,
    inline_code,
    jobs,
    overrides,
    prose,
    run_python,
    short_trainings,
)

import nsm
from nsm.config import compose_config

CONF = ROOT / "conf"
RESULTS = ROOT / "benchmarks" / "results"
DATA = {"text", "bibtex", "yaml", "json"}  # languages of blocks that are not code
# blocks that are not run, by page: this list shall stay short
NOT_RUN: dict[str, list[str]] = {}
# other programs' packages, of which a page has an example that runs where they are installed
OPTIONAL = ("open3d", "polyscope", "pytorch3d")
# tests/test_extending.py runs this page, and looks at what it defines
OWN_TEST = "extending"
PLAIN = [page for page in PAGES if page.stem != OWN_TEST]
TASKS = ["task=overfit", "task=param", "task=pair_map", "task=collection_map"]
ARGUMENTS = {"overrides", "folder", "candidate"}  # of functions, and of the benchmarks
OTHER_COMMANDS = {".", "ssh", "tensorboard"}


def by_name(page: Path) -> str:
    return page.stem


# Code


@pytest.mark.parametrize("page", PAGES, ids=by_name)
def test_blocks_name_their_language(page):
    found = blocks(page)
    assert page.read_text(encoding="utf-8").count("\n```") == 2 * len(found)
    assert {block.language for block in found} <= {"python", "sh", *DATA}
    excused = [b.reason for b in found if b.reason is not None]
    optional = {f"needs {package}" for package in OPTIONAL}
    assert [reason for reason in excused if reason not in optional] == NOT_RUN.get(page.stem, [])
    for block in found:
        if block.language == "yaml":
            assert yaml.safe_load(block.text)
        if block.language == "json":
            assert json.loads(block.text)


@pytest.mark.parametrize("page", [p for p in PLAIN if blocks(p, "python")], ids=by_name)
def test_python_runs_as_it_stands(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with short_trainings():
        run_python(page)


def test_each_public_function_has_an_example():
    code = "".join(block.text for page in PAGES for block in blocks(page, "python"))
    functions = [name for name in nsm.__all__ if not isinstance(getattr(nsm, name), type)]
    assert [name for name in functions if f"nsm.{name}(" not in code] == []


# Commands


@pytest.mark.parametrize("page", [p for p in PLAIN if blocks(p, "sh")], ids=by_name)
def test_commands_can_be_given(page, capsys):
    for words in commands(page):
        program, *rest = words
        if program == "nsm":
            check_nsm(rest, capsys)
        elif program == "make":
            check_make(rest)
        elif program == "pip":
            check_pip(rest)
        else:
            assert program in OTHER_COMMANDS, words


def check_nsm(words, capsys):
    if words[0] in ("landmarks", "report", "view"):
        with pytest.raises(SystemExit):
            import_module(f"nsm.commands.{words[0]}").main(["--help"])
        described = capsys.readouterr().out
        assert all(word in described for word in words if word.startswith("-"))
    elif words[0] == "--help":
        import_module("nsm.help").main(words[1:])
    else:
        for job in jobs(overrides(words)):
            compose_config(job)


def check_make(words):
    rules = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    assert {word for word in words if "=" not in word} <= set(rules)


def check_pip(words):
    assert words[0] == "install"
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    extras = text.partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    for word in words[1:]:
        name, _, asked = word.rstrip("]").partition("[")
        assert name in (".", "nsm")
        assert all(f"\n{extra} = " in extras for extra in asked.split(",") if extra)


@pytest.mark.parametrize("page", PLAIN, ids=by_name)
def test_settings_in_the_text_exist(page):
    for code in set(inline_code(page)):
        program, *words = code.split()
        if program == "make":
            check_make(words)
        elif re.fullmatch(r"nsm\[[\w,]+\]", code):
            check_pip(["install", code])
        elif re.fullmatch(r"(hydra/|\+)?[a-z_][a-z_.]*=[\w.,\[\]-]+", code):
            assert composes(code), f"{page.name}: {code}"


def composes(setting):
    """Whether a setting can be given to one of the tasks."""
    key, _, value = setting.partition("=")
    if key in ARGUMENTS or value.isupper() or value == "...":
        return True
    if (CONF / key).is_dir():  # a group; what an option needs may not be installed
        return (CONF / key / f"{value}.yaml").exists()
    choices = TASKS
    if key.startswith("hydra."):
        group = CONF / "hydra" / key.split(".")[1]
        choices = [f"hydra/{group.name}={file.stem}" for file in group.glob("*.yaml")]
    for choice in choices:
        try:
            compose_config([choice, setting])
        except nsm.NsmError:
            continue
        return True
    return False


# Figures


def rows(text):
    """The cells of the tables in a page, but for the first column and for rows without figures."""
    lines = re.findall(r"^\|(.+)\|$", text, re.MULTILINE)
    cells = [tuple(cell.strip() for cell in line.split("|")) for line in lines]
    return {row[1:] for row in cells if any(re.match(r"[\d*]", cell) for cell in row[1:])}


@pytest.mark.parametrize(
    ("page", "heading", "files"),
    [
        ("maps", "## Measurements", ["maps.md", "closed_maps.md", "classes.md"]),
        (
            "optimization",
            "## Error over time",
            ["overfit.md", "steps.md", "peers.md", "newton_steps.md"],
        ),
        ("activations", "| activation |", ["activation.md"]),
        ("robustness", "<!-- table -->", ["torture.md"]),
        (
            "paper",
            "## The published settings",
            ["maps.md", "baselines.md", "published-reduced.md", "published_changes.md"],
        ),
    ],
)
def test_tables_hold_what_was_measured(page, heading, files):
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    measured = set().union(*(rows((RESULTS / file).read_text(encoding="utf-8")) for file in files))
    shown = rows(text[text.index(heading) :])
    assert shown and shown - measured == set()


def test_the_table_of_parts_holds_what_was_measured():
    text = (ROOT / "docs" / "correspondence.md").read_text(encoding="utf-8")
    section = text[text.index("## Parts of shapes") : text.index("## Measurements")]
    assert rows(section) == rows((RESULTS / "partial.md").read_text(encoding="utf-8"))


def test_the_table_of_correspondences_holds_what_was_measured():
    text = (ROOT / "docs" / "correspondence.md").read_text(encoding="utf-8")
    section = text[text.index("## Measurements") :]
    measured = json.loads((RESULTS / "correspondence.json").read_text(encoding="utf-8"))
    header = re.search(r"^\| shapes \| landmarks or method \| (.+) \|$", section, re.MULTILINE)
    names = header[1].split(" | ")
    figures = {
        (row, *(str(found.get(name, "–")) for name in names))
        for of_kind in measured.values()
        for row, found in of_kind.items()
    }
    assert rows(section) == figures


def test_the_figures_of_the_front_page_were_measured():
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    runs = json.loads((RESULTS / "overfit.json").read_text())["runs"]
    for key in ("bunny/default/0.5", "bunny/paper/60"):
        found, minutes = runs[key]["metrics"], key.split("/")[-1]
        assert re.search(
            rf"{found['rms_percent']:.3f} %.*{found['normal_error_mean_degrees']:.1f}°.*"
            rf"\| {minutes} min",
            page,
        )
    closed = RESULTS / "closed_maps"
    pair = json.loads((closed / "cat-horse.json").read_text())["orbifold"]
    for way, places in (("default", 0), ("fast", 1)):
        found, seconds = pair[way], f"{pair[way]['map_seconds']:.{places}f}"
        assert re.search(
            rf"{found['symmetric_dirichlet_median']:.2f}[ ,].*\| {re.escape(seconds)} s", page
        )
        assert found["flipped_percent"] == found["flipped_before_repair_percent"] == 0
    assert f"({pair['default']['start_symmetric_dirichlet_median']:.2f} as h starts" in page
    names = [str(n) for n in (381, 384, 388, 393)]
    four = [
        json.loads((closed / f"{a}-{b}.json").read_text())["orbifold"]["default"]
        for a, b in itertools.permutations(names, 2)
    ]
    medians = sorted(found["symmetric_dirichlet_median"] for found in four)
    assert not any(found["flipped_percent"] for found in four)
    starts = sorted(found["start_symmetric_dirichlet_median"] for found in four)
    folded = max(found["flipped_before_repair_percent"] for found in four)
    assert f"{medians[0]:.2f} to {medians[-1]:.2f} ({starts[0]:.2f} to {starts[-1]:.2f} as" in page
    assert f"before repair at most {folded:.2f} %" in page
    assert f"| {sum(found['map_seconds'] for found in four) / 12:.0f} s each" in page
    group = json.loads((closed / "collection.json").read_text())["orbifold"]["default"]
    assert group["flipped_percent"] == 0
    assert re.search(
        rf"{group['symmetric_dirichlet_median']:.2f} in the mean.*\| {group['map_seconds']:.0f} s",
        page,
    )
    flat = json.loads((RESULTS / "maps" / "param-cow_free.json").read_text())
    ours, slim = (flat["flattening"][method] for method in ("nsm", "SLIM (libigl)"))
    assert (ours["flipped_percent"], ours["boundary_self_intersections"]) == (0, 0)
    key = "symmetric_dirichlet_median"
    assert f"({flat['flattening']['domain'][key]:.3f} before)" in page
    assert re.search(rf"{ours[key]:.3f}.*{slim[key]:.3f} \| {flat['map_seconds']:.0f} s", page)


def test_the_figures_of_the_papers_pictures_were_measured():
    page = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    shown = page[page.index("## Teaser") : page.index("## The published settings")]
    measured = [json.loads(file.read_text()) for file in (RESULTS / "paper").glob("*.json")]
    flattening = json.loads((RESULTS / "maps" / "energy-flattening.json").read_text())
    values = list(numbers([measured, flattening["energies"]]))
    for figure in set(re.findall(r"(?<![\w.])\d+\.\d{2,3}(?![\w.])", prose_of(shown))):
        places = len(figure.partition(".")[2])
        assert any(f"{value:.{places}f}" == figure for value in values), figure


def dictionaries(found, name=""):
    """All dictionaries in what a JSON file holds, with the keys that lead to them."""
    if isinstance(found, dict):
        yield name, found
    if isinstance(found, dict | list):
        parts = found.items() if isinstance(found, dict) else enumerate(found)
        for key, part in parts:
            yield from dictionaries(part, f"{name}/{key}")


def starts_in(name, found):
    """Whether it has the figures of maps before their optimization, or is these."""
    words = ("start_symmetric_dirichlet_median", "distortion_of_domain", "domain", "before")
    return "as h starts" in name or any(word in found for word in words)


def test_every_result_of_maps_has_the_start_and_flips_before_and_after_repair():
    for file in sorted(RESULTS.rglob("*.json")):
        every = list(dictionaries(json.loads(file.read_text())))
        for name, found in every:
            if "symmetric_dirichlet_median" in found and "nearest points" not in name:
                flips = {"flipped_before_repair_percent", "flipped_percent"}
                assert flips <= found.keys(), f"{file.name}{name}"
        if any("symmetric_dirichlet_median" in found for _, found in every):
            assert any(starts_in(*one) for one in every), file.name


def test_results_of_surfaces_say_that_nothing_flips():
    files = [RESULTS / "activation.json", RESULTS / "overfit.json", *RESULTS.glob("steps/*/*.json")]
    for file in files:
        assert "nothing is repaired" in json.loads(file.read_text())["flips"]


def numbers(found):
    if isinstance(found, dict):
        found = list(found.values())
    if isinstance(found, list):
        for one in found:
            yield from numbers(one)
    elif isinstance(found, float | int):
        yield float(found)


def prose_of(text):
    return re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)


def test_the_performance_page_is_made_from_its_results(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    speed = import_module("speed")
    results = json.loads((RESULTS / "speed.json").read_text())
    assert speed.PAGE.read_text(encoding="utf-8") == speed.page(results)


def test_links_lead_somewhere():
    for page in PAGES:
        for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", prose(page)):
            assert (page.parent / link).exists(), f"{page.name}: {link}"


# The site


class Page(HTMLParser):
    """A page's ids, and the rows of its tables by the heading that they stand under."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.rows: dict[str, list[list[str]]] = {}
        self.heading, self.into, self.text = "", "", ""
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        self.ids.update(value for key, value in attributes if key == "id")
        if tag == "tr":
            self.rows[self.heading].append([])
        if tag in ("h1", "h2", "h3", "td"):
            self.into, self.text = tag, ""

    def handle_data(self, data):
        self.text += data

    def handle_endtag(self, tag):
        if tag != self.into:
            return
        text, self.into = " ".join(self.text.split()), ""
        if tag == "td":
            self.rows[self.heading][-1].append(text)
        else:
            self.heading = text.removesuffix("¶").strip()
            self.rows.setdefault(self.heading, [])


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    pytest.importorskip("mkdocs", reason="needs nsm[docs]")
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    return folder


def test_every_page_is_reached_from_the_front(site):
    front = (site / "index.html").read_text(encoding="utf-8")
    for page in (ROOT / "docs").glob("*.md"):
        assert f'href="{page.stem}.html"' in front


def test_everything_public_is_in_the_reference(site):
    assert {f"nsm.{name}" for name in nsm.__all__} <= Page(site / "api.html").ids


def test_every_option_of_the_configuration_is_on_the_settings_page(site):
    """The files of conf/ are read here without nsm's own code, which writes the page."""
    shown = Page(site / "settings.html").rows
    options = [file for file in CONF.glob("*/*.yaml") if file.parent.name != "hydra"]
    assert len(options) > 40
    for file in options:
        group = file.parent.name
        heading = f"{group}={file.stem}"
        assert heading in shown
        text = file.read_text(encoding="utf-8")
        content = yaml.safe_load(text) or {}
        if "# @package _global_" in text or "@package" in text:
            continue  # of other groups: see below
        values = {row[0]: row[1] for row in shown[heading] if row}
        for key, value in content.items():
            if key not in ("defaults", "_target_") and not isinstance(value, dict):
                assert yaml.safe_load(values[f"{group}.{key}"]) == value


@pytest.mark.parametrize(
    ("option", "key", "value"),
    [
        ("activation=softplus", "activation.beta", 10.0),
        ("map=mlp", "map.width", 64),
        ("encoding=spline_grid", "encoding.resolutions", [32, 128, 512]),
        ("optimizer=adam", "optimizer.lr", 3e-3),
        ("scheduler=cosine", "scheduler.warmup", 100),
        ("sampler=fresh_with_vertices", "sampler.vertex_share", 0.1),
        ("loss_weights=overfit", "loss_weights.normal", 0.01),
        ("loss_weights=adam_pair_map", "loss_weights.triangles", 100.0),
        ("constraints=adam_pair_map", "constraints.multiplier_every", 50),
        ("data=planar", "data.batch_size", 2048),
    ],
)
def test_the_settings_page_gives_the_default(site, option, key, value):
    values = {row[0]: row[1] for row in Page(site / "settings.html").rows[option] if row}
    assert yaml.safe_load(values[key]) == value
