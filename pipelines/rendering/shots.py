"""One training example: a random view of a random scene, its path samples and an independent reference.

A cheap pilot picture turns down scenes that are black, flat, all but free of noise, or nothing but noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from deep_io.flat import HALF_MAX
from model.metrics import EPSILON, common_scale, score
from pipelines.rendering.patterns import join, make_pattern, shuffle_order
from pipelines.rendering.tracer import EMISSION, SceneTracer
from pipelines.rendering.views import COC_RANGE, View, add_camera_motion, add_defocus, choose_view, draw_object_motions

Array = npt.NDArray[np.float32]

ATTEMPTS = 12
# Scenes are scaled so that the metrics' exposure is 1, then by a random factor. Scattered light brighter than a scene's
# draw from CLAMP at that exposure, where the middling brightness is 0.5, is cut alike in samples and reference: else
# references of some hundred samples would be mostly fireflies. Lamps and suns in view hardly add noise, and their
# contrast is what denoisers stumble over: they are cut at EMISSION_CLAMP only.
CLAMP = (60.0, 240.0)
EMISSION_CLAMP = 1e4
BRIGHTNESS_STOPS = 1.5  # standard deviation
# relMSE of eight samples, estimated from a pilot. Scenes harder than HARDEST are noise alone, and at EASIEST there is
# nothing left to learn but to leave the picture as it is. What lies between is kept nearly as it comes: a network that
# sees few scenes under EASY blurs detail where there is little noise.
EASIEST, EASY, HARDEST = 0.006, 0.12, 1.2
EASY_KEPT = 0.85
# The 95th percentile of |coc| in pixels: more than was asked for means that the lens reaches into a wall beside it.
WIDEST_BLUR = 1.5 * COC_RANGE[1]
LIT, CONTRAST = 0.75, 0.08  # least share of surfaces that any path lights, least deviation of log brightness
PILOT, PILOT_SAMPLES = 64, 16

DEFOCUS_SHARE, MOTION_SHARE, STRATIFIED_SHARE, BLACK_SHARE = 0.5, 0.5, 0.5, 0.15
OBJECTS_SHARE, BOTH_SHARE = 0.55, 0.25  # of the scenes with motion: objects move; objects and camera move
TIME_BINS = (8, 16)  # one is drawn for a scene whose samples share times
REFERENCE_PASS = 32
JOINT_REFERENCE = 128  # up to here samples and reference of moving objects share one sweep over the shutter


@dataclass(frozen=True)
class RenderSettings:
    """How a scene is sampled.

    `samples` stored per pixel, `reference` paths per pixel of the target, `size` pixels square (a multiple of 4).
    `halves` adds a second, independent target of as many paths, and changes nothing else.
    `layout` names one kind of scene; `defocus` and `motion` True or False force or forbid it, None leaves it to chance.
    """

    samples: int = 32
    reference: int = 128
    size: int = 192
    layout: str | None = None
    defocus: bool | None = None
    motion: bool | None = None
    halves: bool = False


@dataclass(frozen=True)
class Shot:
    """`channels`: canonical name -> (N,), N = size^2 * samples, pixel-major; `reference` (size, size, 4) RGBA.

    `other_half` is a second reference, independent of the first.
    """

    channels: dict[str, Array]
    reference: Array
    about: dict[str, Any]
    other_half: Array | None = None


def take_shot(load: Callable[[np.random.Generator], SceneTracer], seed: int, settings: RenderSettings) -> Shot:
    """The example of `seed`, drawn again, at most ATTEMPTS times, until its pilot is worth rendering.

    `load` makes a random scene. The same seed, settings and versions give the same example on the same processor.
    """
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([seed, attempt])
        tracer = load(rng)
        try:
            view = choose_view(tracer, rng, settings.size)
            view = add_defocus(view, rng) if _decide(settings.defocus, DEFOCUS_SHARE, rng) else view
            black = bool(rng.random() < BLACK_SHARE)
            if attempt < ATTEMPTS - 1 and not is_worth_rendering(tracer, view, black, rng):
                continue
            view = _add_motion(tracer, view, rng) if _decide(settings.motion, MOTION_SHARE, rng) else view
            shot = _expose(tracer, view, black, rng, settings)
            return replace(shot, about={"seed": seed, "attempt": attempt, **shot.about})
        finally:
            tracer.close()
    raise AssertionError("the last attempt is always kept")


def _decide(forced: bool | None, share: float, rng: np.random.Generator) -> bool:
    drawn = bool(rng.random() < share)
    return drawn if forced is None else forced


def estimated_noise(radiance: Array, samples: int = 8) -> float:
    """relMSE that `samples` of the paths (P, S, 3) would have, from their variance. P is a square picture, side 4k.

    Pixels of rare bright paths are black in their own mean, so the denominator comes from blocks of 4 x 4 pixels.
    """
    size = round(len(radiance) ** 0.5)
    mean = radiance.mean(1).reshape(size, size, 3)
    scale = _exposure(mean)
    rough = mean.reshape(size // 4, 4, size // 4, 4, 3).mean((1, 3)).repeat(4, 0).repeat(4, 1).reshape(-1, 3) * scale
    variance = radiance.var(1, ddof=1) * scale**2
    return float((variance / samples / (rough**2 + EPSILON)).mean())


def is_worth_rendering(tracer: SceneTracer, view: View, black: bool, rng: np.random.Generator) -> bool:
    """Whether a scene teaches, by a small still picture."""
    pattern = make_pattern(rng, PILOT**2, PILOT_SAMPLES, False, None)
    channels = tracer.trace(view.camera.resized(PILOT), pattern, int(rng.integers(2**31)))
    if _percentile_95(channels, np.abs(channels["coc"])) * view.camera.size / PILOT > WIDEST_BLUR:
        return False
    _clean(channels, black)
    radiance = _stack(channels, PILOT_SAMPLES)
    hit = channels["A"].reshape(-1, PILOT_SAMPLES).any(1)
    image = radiance.mean(1)
    if not hit.any() or (image[hit].mean(1) > 0).mean() < LIT:
        return False
    scale = _exposure(image.reshape(PILOT, PILOT, 3))
    noise = estimated_noise(np.minimum(radiance, CLAMP[0] / scale))
    if np.log1p(image.mean(1) * scale).std() < CONTRAST or not EASIEST < noise < HARDEST:
        return False
    return noise > EASY or bool(rng.random() < EASY_KEPT)


def _add_motion(tracer: SceneTracer, view: View, rng: np.random.Generator) -> View:
    """Objects move, or the camera, or both; the camera also where nothing in view can move."""
    which = rng.random()
    moved = draw_object_motions(view, tracer.movable(), rng) if which < OBJECTS_SHARE else {}
    if moved:
        tracer.set_motions(moved)
        view = replace(view, object_motion=True)
    return view if moved and which >= BOTH_SHARE else add_camera_motion(view, rng)


def _expose(tracer: SceneTracer, view: View, black: bool, rng: np.random.Generator, settings: RenderSettings) -> Shot:
    """Trace samples and reference, bring both to one exposure and put the samples in a fair order."""
    n, size = settings.samples, settings.size
    stratified = bool(rng.random() < STRATIFIED_SHARE)
    bins = draw_time_bins(view, rng)
    channels, passes = _trace(tracer, view, stratified, bins, rng, settings)
    order = shuffle_order(rng, size**2, n)
    channels = {name: values[order] for name, values in channels.items()}
    broken = _clean(channels, black)
    scale = _exposure(_stack(channels, n).mean(1).reshape(size, size, 3))
    brightness = float(np.exp2(rng.normal(0, BRIGHTNESS_STOPS)))
    limit = float(np.exp(rng.uniform(*np.log(CLAMP))))
    scale_and_cut(channels, scale, limit, brightness)

    def mean(passes: Iterator[dict[str, Array]]) -> Array:
        nonlocal broken
        total = np.zeros((size, size, 4))
        for part in passes:
            broken += _clean(part, black)
            scale_and_cut(part, scale, limit, brightness)
            total += np.stack([part[c].reshape(size, size, -1).sum(2, dtype=np.float64) for c in "RGBA"], -1)
        return (total / settings.reference).astype(np.float32)

    reference, other = mean(passes), None
    if settings.halves:
        seed = int(rng.integers(2**31))
        other = mean(_reference_passes(tracer, view, stratified, bins, rng, settings, seed))
    about = tracer.describe() | {
        "settings": asdict(settings), "defocus": view.defocus, "camera_motion": view.camera_motion,
        "object_motion": view.object_motion, "stratified": stratified, "time_bins": bins, "black_background": black,
        "brightness": brightness, "clamp": limit, "non_finite_paths": broken, **_measure(channels, reference, other, n)}
    return Shot(channels, reference, about, other)


def scale_and_cut(channels: dict[str, Array], scale: float, limit: float, brightness: float) -> None:
    """Bring R, G, B to the example's brightness, in place: scattered light and emission each up to its own limit.

    Both end at the most that half holds, which is how samples are stored; the reference is no brighter.
    """
    for c, name in zip("RGB", EMISSION, strict=True):
        emitted = channels.pop(name)
        scattered = np.minimum((channels[c] - emitted) * scale, limit)
        light = (np.minimum(emitted * scale, EMISSION_CLAMP) + scattered) * brightness
        channels[c] = np.minimum(light, HALF_MAX).astype(np.float32)


def draw_time_bins(view: View, rng: np.random.Generator) -> int | None:
    """How many times the samples of all pixels share, evenly over the shutter; None: each has its own.

    Renderers that step through the shutter show what moves as often as they step, sharply. Objects move in steps
    always, since each time rebuilds the scene; the camera alone in half of the scenes.
    """
    bins = int(rng.choice(TIME_BINS))
    smooth = rng.random() < 0.5
    if view.object_motion or (view.camera_motion and not smooth):
        return bins
    return None


def _trace(tracer: SceneTracer, view: View, stratified: bool, bins: int | None, rng: np.random.Generator,
           settings: RenderSettings) -> tuple[dict[str, Array], Iterator[dict[str, Array]]]:
    """The samples' channels and, pass by pass as they are traced, the reference's R, G, B, EMISSION and A.

    All are (N,), pixel-major.
    """
    pixels, n, reference = settings.size**2, settings.samples, settings.reference
    seeds = [int(s) for s in rng.integers(2**31, size=2)]
    pattern = make_pattern(rng, pixels, n, stratified, bins)
    if tracer.moving and reference <= JOINT_REFERENCE:
        # Every time bin rebuilds the scene, so both share one sweep; each path has random numbers of its own.
        target = make_pattern(rng, pixels, reference, stratified, bins)
        both = tracer.trace(view.camera, join(pattern, target), seeds[0])
        tables = {name: values.reshape(pixels, -1) for name, values in both.items()}
        return ({name: table[:, :n].ravel() for name, table in tables.items()},
                iter([{name: tables[name][:, n:].ravel() for name in ("R", "G", "B", "A", *EMISSION)}]))
    passes = _reference_passes(tracer, view, stratified, bins, rng, settings, seeds[1])
    return tracer.trace(view.camera, pattern, seeds[0], stratified), passes


def _reference_passes(tracer: SceneTracer, view: View, stratified: bool, bins: int | None, rng: np.random.Generator,
                      settings: RenderSettings, seed: int) -> Iterator[dict[str, Array]]:
    """A reference's channels, as `_trace` has them, in passes that fit in memory."""
    reference = settings.reference
    count = max(1, round(reference / (JOINT_REFERENCE if tracer.moving else REFERENCE_PASS)))
    for k in range(count):
        share = reference // count + (k < reference % count)
        pattern = make_pattern(rng, settings.size**2, share, stratified, bins)
        yield tracer.trace(view.camera, pattern, seed + k, stratified, "coverage")


def _exposure(image: Array) -> float:
    """The metrics' scale; 1 for a picture too dark to have one."""
    try:
        return common_scale(image)
    except ValueError:
        return 1.0


def _stack(channels: dict[str, Array], samples: int) -> Array:
    """Radiance (P, S, 3)."""
    return np.stack([channels[c] for c in "RGB"], -1).reshape(-1, samples, 3)


def _clean(channels: dict[str, Array], black: bool) -> int:
    """Zero non-finite radiance in place, and that of misses if the background is to be black. Count the former."""
    light = ("R", "G", "B", *EMISSION)
    bad = ~np.isfinite(np.sum([channels[c] for c in light], 0))
    for c in light:
        channels[c][bad] = 0.0
        if black:
            channels[c] *= channels["A"]
    return int(bad.sum())


def _measure(channels: dict[str, Array], reference: Array, other: Array | None, samples: int) -> dict[str, float]:
    """How hard the example is: errors of its first eight samples, and how far it is blurred."""
    radiance, target = _stack(channels, samples), reference[..., :3]
    half = None if other is None else other[..., :3]
    mean = target if half is None else (target + half) / 2
    about = {"coverage": float((channels["A"] > 0).mean()), "coc_95": _percentile_95(channels, np.abs(channels["coc"])),
             "motion_95": _percentile_95(channels, np.hypot(channels["motion.X"], channels["motion.Y"])),
             "energy": float(radiance.mean() / max(float(mean.mean()), 1e-12))}
    if float(np.percentile(target, 99)) > 0:
        noisy = score(radiance[:, :8].mean(1).reshape(target.shape), target, half, with_flip=False)
        about |= {"relmse8": noisy.relmse, "relmse8_trimmed": noisy.relmse_trimmed, "smape8": noisy.smape}
        if noisy.floor is not None:
            about["reference_floor"] = noisy.floor
    return about


def _percentile_95(channels: dict[str, Array], values: Array) -> float:
    """Of the samples that hit something; 0 where none does."""
    hit = channels["A"] > 0
    return float(np.quantile(values[hit], 0.95)) if hit.any() else 0.0
