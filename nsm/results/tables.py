"""Figures as short tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping

from rich.table import Table

_ROWS = {
    "rms_percent": ("RMS distance", "% of diagonal"),
    "max_percent": ("largest distance", "% of diagonal"),
    "hausdorff_mesh_to_phi_percent": ("Hausdorff, mesh to φ", "% of diagonal"),
    "hausdorff_phi_to_mesh_percent": ("Hausdorff, φ to mesh", "% of diagonal"),
    "normal_error_mean_degrees": ("normal error, mean", "degrees"),
    "normal_error_p95_degrees": ("normal error, 95th percentile", "degrees"),
    "degenerate_triangles_percent": ("degenerate triangles", "%"),
    "seam_gap_percent": ("largest gap along the seam", "% of diagonal"),
}


def metrics_table(metrics: Mapping[str, float]) -> Table:
    """The figures of :func:`nsm.results.overfit_metrics` with their names and units."""
    table = Table("figure", "value", "unit")
    table.columns[1].justify = "right"
    for key, (label, unit) in _ROWS.items():
        table.add_row(label, f"{metrics[key]:.3f}", unit)
    return table
