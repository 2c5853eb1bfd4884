"""Figures as short tables for the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from rich.table import Column, Table
from rich.text import Text

from nsm.energies.distortion import LEAST_SYMMETRIC_DIRICHLET
from nsm.results.pair_metrics import START

_ROWS = {
    "rms_percent": ("RMS distance", "% of diagonal"),
    "max_percent": ("largest distance", "% of diagonal"),
    "hausdorff_mesh_to_phi_percent": ("Hausdorff, mesh to φ", "% of diagonal"),
    "hausdorff_phi_to_mesh_percent": ("Hausdorff, φ to mesh", "% of diagonal"),
    "normal_error_mean_degrees": ("normal error, mean", "degrees"),
    "normal_error_p95_degrees": ("normal error, 95th percentile", "degrees"),
    "degenerate_triangles_percent": ("degenerate triangles", "%"),
    "seam_gap_percent": ("largest gap along the seam", "% of diagonal"),
    "normal_variation_error_degrees": ("normal variation, error", "degrees over 1 %"),
    "normal_variation_excess_degrees": ("normal variation, excess", "degrees over 1 %"),
}


def metrics_table(metrics: Mapping[str, float]) -> Table:
    """The figures of :func:`nsm.results.overfit_metrics` with their names and units."""
    return _figures(metrics, _ROWS)


_MAP_COLUMNS = {
    "symmetric_dirichlet_median": "D_iso, median",
    "symmetric_dirichlet_p95": "95th per- centile",
    "conformal_median": "D_conf, median",
    "singular_value_ratio_median": "σ₁/σ₂, median",
    "flipped_before_repair_percent": "flipped % before repair",
    "flipped_percent": "after",
    "boundary_self_intersections": "overlaps",
}
# what a method of :class:`nsm.results.Parameterization` is called in the table
_METHODS = {"domain": "before: domain Ω", "given": "before: given UV"}


def comparison_table(metrics: Mapping[str, Mapping[str, float]]) -> Table:
    """The figures of :func:`nsm.results.planar_metrics`, a row for each map.

    D_iso is symmetric Dirichlet (METHOD, Eq. 2), D_conf the conformal energy (Eq. 3).
    """
    table = narrow(Column("map", no_wrap=True), _MAP_COLUMNS.values())
    for name, figures in metrics.items():
        shown = (_brief(figures, key) for key in _MAP_COLUMNS)
        table.add_row(_METHODS.get(name, name), *shown)
    table.caption = f"D_iso is {LEAST_SYMMETRIC_DIRICHLET} at best, D_conf 0, σ₁/σ₂ 1"
    return table


# percent of the diagonal by which a seam's sides may part before it is said
_TORN = 1.0
# median symmetric Dirichlet of lengths stretched by 2.4 one way and shrunk as much the other. Maps
# of the animals, busts and a plane and bird have 7 at most, those by wrong landmarks 13 and more
_DISTORTED = 12.0
# percent of the diagonal by which a landmark may miss its place before it is said
_MISSED = 5.0
# percent of triangles folded before the repair from which on it is said: good maps have 0.4 at
# most, those that landmarks pull to the wrong side of others 1 to 30
_FOLDED = 1.0
# percent of the diagonal by which φ may be off its mesh, RMS: fits are at 0.02, the shortest
# trainings of small networks at 0.1 to 0.5
_MISFIT = 1.0

_PAIR_ROWS = {
    "symmetric_dirichlet_median": (
        "symmetric Dirichlet, median",
        f"{LEAST_SYMMETRIC_DIRICHLET} at best",
    ),
    "symmetric_dirichlet_mean": ("symmetric Dirichlet, mean", ""),
    "symmetric_dirichlet_p95": ("symmetric Dirichlet, 95th percentile", ""),
    "singular_value_ratio_median": ("σ₁/σ₂, median", "1 at best"),
    "flipped_before_repair_percent": ("flipped triangles, before repair", "%"),
    "flipped_percent": ("flipped triangles", "%"),
    "outside_percent": ("vertices outside Ω", "%"),
    "landmark_error_mean_percent": ("landmark error, mean", "% of diagonal"),
    "landmark_error_max_percent": ("landmark error, largest", "% of diagonal"),
    "landmark_correlation": ("landmarks' distances, correlation", "1 for like shapes"),
    "covered_percent": ("target covered", "% of area"),
    "seam_gap_mean_percent": ("gap across the seam, mean", "% of diagonal"),
    "seam_gap_max_percent": ("gap across the seam, largest", "% of diagonal"),
    "welded_flipped_triangles": ("triangles turned over by the weld", ""),
    "welded_move_max_percent": ("way of the weld, largest", "% of diagonal"),
}


def pair_table(metrics: Mapping[str, float]) -> Table:
    """The main figures of :func:`nsm.results.pair_metrics` with their names and units, beside those
    of the map before its optimization, if there are any."""
    return _figures(metrics, _PAIR_ROWS, missing=("landmark_error_max_percent",))


def warning_of_tears(name: str, metrics: Mapping[str, float]) -> Text | None:
    """A line in red, if a map of cut surfaces tears the closed ones; None if it does not.

    Args:
        name: of the map.
        metrics: of :func:`nsm.results.pair_metrics`.
    """
    return _warning(
        {name: metrics},
        "seam_gap_max_percent",
        _TORN,
        lambda of: (
            "the surface is torn along its seam, by "
            f"{of['seam_gap_max_percent']:.3g} % of the diagonal at worst "
            f"({of['seam_gap_mean_percent']:.3g} % in the mean). Give more landmarks, or, for "
            "closed surfaces of genus 0 or 1, domain=orbifold or domain=torus, which have no seam"
        ),
    )


def warning_of_distortion(maps: Mapping[str, Mapping[str, float]]) -> Text | None:
    """A line in red, if half of a map's triangles are distorted more than like shapes ever ask for;
    None if there is no such map.

    Args:
        maps: the figures of :func:`nsm.results.pair_metrics` of each, by its name.
    """
    return _warning(
        maps,
        "symmetric_dirichlet_median",
        _DISTORTED,
        lambda of: (
            "strongly distorted, median symmetric Dirichlet "
            f"{of['symmetric_dirichlet_median']:.1f} ({LEAST_SYMMETRIC_DIRICHLET} at best), 95th "
            f"percentile {of['symmetric_dirichlet_p95']:.0f}. A certificate says only that a map "
            "is continuous and injective. Check the landmarks in landmarks.png, or give more of "
            "them"
        ),
    )


def warning_of_missed_landmarks(maps: Mapping[str, Mapping[str, float]]) -> Text | None:
    """A line in red, if a landmark goes far past its place; None if none does.

    Args:
        maps: as for :func:`warning_of_distortion`.
    """
    return _warning(
        maps,
        "landmark_error_max_percent",
        _MISSED,
        lambda of: (
            f"a landmark is missed by {of['landmark_error_max_percent']:.1f} % of the diagonal "
            f"({of['landmark_error_mean_percent']:.1f} % in the mean): landmarks contradict each "
            "other, or the training was too short"
        ),
    )


def warning_of_folds(maps: Mapping[str, Mapping[str, float]]) -> Text | None:
    """A line in red, if a map had more folds before its repair than good maps have; None if none
    had.

    Args:
        maps: as for :func:`warning_of_distortion`.
    """
    return _warning(
        maps,
        "flipped_before_repair_percent",
        _FOLDED,
        lambda of: (
            f"{of['flipped_before_repair_percent']:.1f} % of the triangles were folded before the "
            "repair, which hardly happens in right maps: parts may go to wrong places. Check the "
            "landmarks in landmarks.png, or give more of them"
        ),
    )


def warning_of_misfit(surfaces: Mapping[str, Mapping[str, float]]) -> Text | None:
    """A line in red, if a neural surface is not near its mesh; None if all are.

    Args:
        surfaces: the figures of :func:`nsm.results.overfit_metrics` of each, by its name.
    """
    return _warning(
        surfaces,
        "rms_percent",
        _MISFIT,
        lambda of: (
            f"φ is {of['rms_percent']:.3g} % of the diagonal off the mesh (RMS): what is made from "
            "it belongs to another surface. Train it longer, or begin with the fit, "
            "initialization=fitted"
        ),
        kind="surfaces",
    )


def warning_of_no_landmarks(name: str) -> Text:
    """A line for a map of meshes that nothing but its distortion has chosen.

    Args:
        name: of the map.
    """
    return Text(
        f"WARNING: {name}: without landmarks, this is the least distorted of the maps that were "
        "tried, and NOT SURE to take parts to those that correspond; look at transfer.png, and "
        "give landmarks if it does not",
        style="yellow",
    )


def _warning(
    maps: Mapping[str, Mapping[str, float]],
    key: str,
    most: float,
    words: Callable[[Mapping[str, float]], str],
    kind: str = "maps",
) -> Text | None:
    """A line in red on the maps, or others of a kind, whose figure is above ``most``; None if there
    is no such one.

    Args:
        maps: the figures of each, by its name.
        key: of the figure.
        most: that is well.
        words: what is said of the figures of the worst one.
        kind: of what there are several.
    """
    far = [name for name, of in maps.items() if of.get(key, 0.0) > most]
    if not far:
        return None
    worst = max(far, key=lambda name: maps[name][key])
    which = worst if len(maps) == 1 else f"{len(far)} of {len(maps)} {kind}, {worst} most"
    return Text(f"{which}: {words(maps[worst])}", style="bold red")


_COLLECTION_COLUMNS = {
    "start_symmetric_dirichlet_median": "median at start",
    "symmetric_dirichlet_median": "median at end",
    "symmetric_dirichlet_p95": "95th per- centile",
    "flipped_before_repair_percent": "flipped % before repair",
    "flipped_percent": "after",
    "outside_percent": "outside %",
    "landmark_error_max_percent": "marks off, most %",
    "seam_gap_mean_percent": "seam gap, mean %",
}


def collection_table(metrics: Mapping[str, Any]) -> Table:
    """The figures of :func:`nsm.results.collection_metrics`, a row for each ordered pair; medians
    are of symmetric Dirichlet."""
    every = {key for figures in metrics["pairs"].values() for key in figures}
    columns = {key: label for key, label in _COLLECTION_COLUMNS.items() if key in every}
    table = narrow(Column("pair", no_wrap=True), columns.values())
    for name, figures in metrics["pairs"].items():
        shown = (_brief(figures, key) for key in columns)
        table.add_row(name, *shown)
    cycle = [metrics[f"cycle_error_{key}_percent"] for key in ("mean", "max")]
    table.caption = (
        f"symmetric Dirichlet, {LEAST_SYMMETRIC_DIRICHLET} at best; cycle error: mean "
        f"{cycle[0]:.2g} %, maximum {cycle[1]:.2g} % of the diagonal"
    )
    return table


_WIDEST = 5  # characters of a figure in a narrow table


def _brief(figures: Mapping[str, float], key: str) -> str:
    """A figure in so few characters."""
    if key not in figures:
        return "–"
    value = figures[key]
    return f"{value:.3f}" if abs(value) < 10 else f"{value:#.4g}"


def narrow(first: Column, headings: Iterable[str]) -> Table:
    """A table whose headings, and names of rows, break between words, to fit a terminal of 80
    columns; figures do not."""
    table = Table(first, padding=(0, 1, 0, 0))
    for heading in headings:
        table.add_column(heading, width=max(_WIDEST, *map(len, heading.split())))
    return table


# figure -> label, unit, of all tasks
FIGURES: dict[str, tuple[str, str]] = {
    **_PAIR_ROWS,
    **{
        f"start_{key}": (f"before optimization: {label}", unit)
        for key, (label, unit) in _PAIR_ROWS.items()
        if key in START
    },
    **_ROWS,
    "conformal_median": ("D_conf, median", "0 at best"),
    "area_median": ("area, median", "0 at best"),
    "boundary_self_intersections": ("overlaps of the boundary", ""),
    "cycle_error_mean_percent": ("cycle error, mean", "% of diagonal"),
    "cycle_error_max_percent": ("cycle error, largest", "% of diagonal"),
    "certified": ("certified injective", ""),
    "landmarks_doubtful": ("landmarks doubtful", ""),
    "landmarks_sure": ("proposed landmarks sure", ""),
    "steps": ("steps", ""),
    "seconds": ("time", "s"),
}


def _figures(
    metrics: Mapping[str, float],
    rows: Mapping[str, tuple[str, str]],
    missing: Sequence[str] = (),
) -> Table:
    """The rows that there are figures for; of the ``missing`` ones, a dash instead."""
    before = any(f"start_{key}" in metrics for key in rows)
    table = Table("figure", *(["at the start"] if before else []), "value", "unit")
    for column in table.columns[1:-1]:
        column.justify = "right"
    for key, (label, unit) in rows.items():
        if key in metrics or key in missing:  # a closed domain has no seam to report
            start = metrics.get(f"start_{key}")
            first = ["" if start is None else f"{start:.3f}"] if before else []
            table.add_row(label, *first, *_shown(metrics, key, unit))
    return table


def _shown(metrics: Mapping[str, float], key: str, unit: str) -> tuple[str, str]:
    return (f"{metrics[key]:.3f}", unit) if key in metrics else ("–", "not measured")
