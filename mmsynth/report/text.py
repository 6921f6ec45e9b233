"""Scores and figures as tables of plain text."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mmsynth.operations.simulation.calibrate_noise import Calibrated
    from mmsynth.prior.prior import Prior

_COLUMNS = {
    "psnr": "psnr [dB]",
    "psnr_view_mean": "view mean",
    "psnr_foreground": "foreground",
    "psnr_foreground_view_mean": "view mean",
    "psnr_moved": "moved [dB]",
    "psnr_foreground_moved": "foreground",
    "ssim": "ssim",
    "lpips": "lpips",
    "psnr_truth": "truth [dB]",
    "psnr_truth_moved": "moved",
    "psnr_aligned": "aligned [dB]",
    "psnr_aligned_free_gain": "free gain",
    "within_2sd": "within 2 sd",
    "psnr_highlights": "highlights",
    "psnr_silhouettes": "silhouettes",
    "psnr_rest": "rest",
    "sam": "sam [deg]",
    "dolp_rmse": "dolp rmse",
    "aolp_mae": "aolp [deg]",
}


def prior_text(prior: Prior, path: Path) -> str:
    """What a prior knows, for a terminal."""
    return f"wrote {path} ({path.stat().st_size / 1000:.0f} kB): {', '.join(prior.sensors)}, of {len(prior.scenes)} scenes"


def fit_text(facts: Mapping[str, Any]) -> str:
    """What a fit came to (``Run.facts``): length, speed, PSNR on training pixels, and where it is."""
    psnr = ", ".join(f"{n} {v:.1f}" for n, v in facts["train_psnr"].items())
    return (
        f"{facts['steps']} steps in {facts['seconds']['fit']:.0f} s, {facts['rays_per_s']:,.0f} rays/s\n"
        f"PSNR on training pixels [dB]: {psnr}\n"
        f"wrote {facts['run']}/ (field.safetensors, manifest.json, preview.png, report.html)"
    )


def score_text(scores: Mapping[str, Any]) -> str:
    """The result of ``evaluate`` as lines: one row per modality, then geometry and speed."""
    modalities: Mapping[str, Mapping[str, Any]] = scores["modalities"]
    sources = {m["foreground_from"] for m in modalities.values() if "foreground_from" in m}
    told = {k for m in modalities.values() for k in m}
    keys = [k for k in _COLUMNS if k in told and (not k.endswith("view_mean") or "masks" in sources)]
    lines = ["".join([f"{'modality':10s}"] + [f"{_COLUMNS[k]:>12s}" for k in keys])]
    for name, m in modalities.items():
        label = f"{name} *" if m.get("predicted") else name
        lines.append("".join([f"{label:10s}"] + [f"{m[k]:12.3f}" if isinstance(m.get(k), float) else f"{'':12s}" for k in keys]))
    if any(m.get("predicted") for m in modalities.values()):
        lines.append("*: predicted by a prior, not measured; free gain: aligned, with the one gain that suits best")
    if "masks" in sources:
        lines.append("foreground: within the masks; dB of the error pooled over all views, then view mean: the mean of dB over views")
    if "opacity" in sources:
        lines.append("foreground: the field's own opacity > 0.5, for want of masks; not comparable between fits")
    if moved := scores.get("moved_px"):
        lines.append(f"moved: {moved_text(moved)}")
    lines += [f"{key}: {value:.5g}" for key, value in scores.get("geometry", {}).items() if isinstance(value, float)]
    seconds = ", ".join(f"{k} {v:.1f}" for k, v in scores.get("seconds", {}).items() if isinstance(v, (int, float)))
    lines.append(f"seconds: {seconds}; {scores.get('rays_per_s', 0):,.0f} rays/s")
    return "\n".join(lines)


def moved_text(pixels: Mapping[str, float]) -> str:
    """What ``psnr_moved`` is, by ``moved_px``."""
    off = statistics.fmean(pixels.values())
    return f"the fit moved its views; those that it did not learn from are off by {off:.2f} pixels (mean), by what their frames show"


def conversion_text(found: Sequence[Mapping[str, Any]]) -> str:
    """The result of ``evaluate --convert``: per pair a row for each method, what ``auto`` made of them, and what it went by."""
    columns = {
        "psnr": "psnr [dB]", "psnr_region": "region", "ssim": "ssim", "sam": "sam [deg]", "ergas": "ergas", "stokes_rmse": "stokes rmse",
        "dolp_rmse": "dolp rmse", "aolp_mae": "aolp [deg]",
    }  # fmt: skip
    keys = [k for k in columns if any(k in m for pair in found for m in pair["methods"].values())]
    lines = ["".join([f"{'':28s}"] + [f"{columns[k]:>12s}" for k in keys])]
    for pair in found:
        views = f"{len(pair['views'])} frames, truth: {pair['truth']}, {pair['seconds_per_frame']:.2f} s a frame"
        lines.append(f"{pair['source']} to {pair['target']} ({views})")
        for name, m in pair["methods"].items():
            lines.append("".join([f"  {name:26s}"] + [f"{m[k]:12.3f}" if k in m else f"{'':12s}" for k in keys]))
        why = "" if pair["evidence"] is not None else ", by the kind of the modalities: no training view has frames of both"
        lines.append(f"  {_weights_text(pair['auto'], pair['evidence'])}{why}")
    return "\n".join(lines)


def converted_text(sidecars: Sequence[Mapping[str, Any]]) -> str:
    """How frames were converted: the mean over their sidecars of how much of each method was taken, and why."""
    names = {name: None for sidecar in sidecars for name in sidecar["weights"]}
    mean = {name: sum(sidecar["weights"].get(name, 0.0) for sidecar in sidecars) / len(sidecars) for name in names}
    return _weights_text(mean, sidecars[0]["evidence"])


def _weights_text(weights: Mapping[str, float], evidence: Mapping[str, Any] | None) -> str:
    taken = " + ".join(f"{weight:.2f} {name}" for name, weight in sorted(weights.items(), key=lambda item: -item[1]) if weight >= 0.005)
    if evidence is None:
        return f"method: {taken}"
    scored = ", ".join(f"{name} {value:.1f}" for name, value in evidence["psnr"].items())
    lines = [f"auto: {taken}; dB at {len(evidence['views'])} training views: {scored}"]
    for name in evidence["light_moves"]:
        light = evidence["light_of_the_camera"][name]
        lines.append(f"{name}: its light seems to move with the camera (exponent of cos θ / d²: {light['share']:.2f} ± {light['sd']:.2f})")
    return "; ".join(lines)


def noise_text(calibrated: Mapping[str, Calibrated], out: Path) -> str:
    """The result of ``calibrate-noise``, written to ``out``: one row per sensor, with standard deviations; "<": too small
    to be measured, and the least that would have been; "–": one frame alone shows no pattern.
    Exposure: the frames' median, in units of what the field learned."""
    lines = [
        f"{'sensor':14s}{'frames':>7s}{'exposure':>9s}{'bits':>5s}{'gain [DN/e-]':>20s}{'full scale [e-]':>18s}{'read [e-]':>14s}"
        f"{'PRNU [%]':>14s}"
    ]

    def pair(value: float, sd: float, digits: int) -> str:
        return f"{value:.{digits}f} ± {sd:.{digits}f}" if value > 0 else "–" if sd >= 100.0 else f"< {sd:.{digits}f}"

    for name, c in calibrated.items():
        p, noise = c.found, c.file.noise
        full = noise.electrons_at_one
        exposure = f"{statistics.median(c.exposure):.3g}" if c.exposure else "–"
        lines.append(
            f"{name:14s}{c.frames:7d}{exposure:>9s}{noise.bits:5d}{f'{p.gain_dn_e:.4g} ± {p.gain_sd:.2g}':>20s}"
            f"{pair(full, full * p.gain_sd / p.gain_dn_e, 0):>18s}{pair(p.read_e, p.read_sd, 1):>14s}"
            f"{pair(100 * p.prnu, 100 * p.prnu_sd, 2):>14s}"
        )
    files = ", ".join(f"{name}.toml" for name in calibrated)
    return "\n".join([*lines, f"wrote {out}/ ({files}, noise.svg)"])


def mesh_text(report: Mapping[str, Any]) -> str:
    """The result of ``mesh`` as lines."""
    unit, (low, high) = report["unit"], report["bounds"]
    size = " x ".join(f"{b - a:.4g}" for a, b in zip(low, high, strict=True))
    closed = f"watertight, volume {report['volume']:.4g} {unit}³" if report["watertight"] else f"open, {report['boundary_edges']:,} edges"
    residual = report["residual"]
    lines = [
        f"wrote {report['out']}: {report['vertices']:,} vertices, {report['faces']:,} faces, in {unit}",
        f"{report['components']} component{'s' * (report['components'] != 1)}, {closed}, Euler number {report['euler_number']}",
        f"{size} {unit}, cells of {report['cell']:.3g}, vertices {residual['rms_cells']:.1e} cells off the field's zero (rms)",
    ]
    if "against" in report:
        scores = report["against"]
        f_scores = ", ".join(f"{value:.3f} at {distance}" for distance, value in scores["f_score"].items())
        lines.append(
            f"against {scores['mesh']}: accuracy {scores['accuracy']:.4g}, completeness {scores['completeness']:.4g}, Chamfer "
            f"{scores['chamfer']:.4g} {unit}; F-score {f_scores}; normals {scores['normal_consistency']:.3f}"
        )
        if scores["reference_in_region"] < 0.5:
            share = f"{scores['reference_in_region']:.0%}"
            lines.append(f"note: only {share} of the reference lies in the region of interest; is it in the mesh's frame and in {unit}?")
    lines.append("seconds: " + ", ".join(f"{key} {value:.1f}" for key, value in report["seconds"].items()))
    return "\n".join(lines)


def export_text(facts: Mapping[str, Any]) -> str:
    """What was exported (``Exported.facts``), and a line for everything that did not fit into the layout."""
    frames = ", ".join(f"{count} of {name}" for name, count in facts["frames"].items())
    beside = "".join(f", {facts[key]:,} {what}" for key, what in (("masks", "masks"), ("points", "sparse points")) if facts[key])
    return "\n".join([*(f"note: {note}" for note in facts["notes"]), f"wrote {facts['out']}/ ({facts['layout']}: {frames}{beside})"])
