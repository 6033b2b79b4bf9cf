"""The rendering job behind `lbmc render`: which examples are missing, who renders them, what is told."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from deep_io.cores import usable_cores
from deep_io.errors import InputError, UsageError
from pipelines.jobs import JobReport, run_frames
from pipelines.progress import Progress, ProgressKind, make_progress
from pipelines.rendering.backend import load_mitsuba
from pipelines.rendering.contact import load_pillow, write_contact_sheet
from pipelines.rendering.file_scene import FileTracer
from pipelines.rendering.layouts import LAYOUTS
from pipelines.rendering.output import example_files, write_example
from pipelines.rendering.shots import RenderSettings, Shot, take_shot
from pipelines.rendering.stage import Stage
from pipelines.rendering.stage_scene import StageTracer
from pipelines.rendering.tracer import SceneTracer
from pipelines.rendering.workers import worker_pool

CONTACT_SHEET = "contact-sheet.png"


@dataclass(frozen=True)
class RenderOptions:
    """What to render: `count` examples of the seeds from `seed` on, into the folder `outdir`.

    scene     a Mitsuba scene file to take views of; None for random procedural scenes
    workers   processes; each renders examples of its own
    threads   threads of each process; None shares the cores between the workers
    """

    outdir: Path
    count: int
    seed: int = 1
    settings: RenderSettings = field(default_factory=RenderSettings)
    scene: Path | None = None
    workers: int = 1
    threads: int | None = None
    contact_sheet: bool = True


def example_stem(outdir: Path, seed: int) -> Path:
    """The path of an example's files without their extensions."""
    return outdir / f"scene{seed:06d}"


def render_example(seed: int, settings: RenderSettings, scene: Path | None = None, threads: int = 0) -> Shot:
    """One example in memory. Raises RendererMissingError, and InputError for a scene file that cannot be used."""
    if scene is None:
        return take_shot(partial(_random_stage, seed, settings.layout, threads), seed, settings)
    digest = scene_digest(scene)
    shot = take_shot(lambda rng: _file_tracer(scene, digest, threads), seed, settings)
    return replace(shot, about=shot.about | {"scene": scene.name, "scene_digest": digest})


def scene_digest(scene: Path) -> str:
    """The SHA-256 of a scene file, not of the files that it refers to. Raises OSError."""
    return hashlib.sha256(scene.read_bytes()).hexdigest()


@lru_cache(maxsize=1)
def _file_tracer(scene: Path, digest: str, threads: int) -> FileTracer:
    """The scene stays loaded between examples as long as the file is the same."""
    return FileTracer(scene, threads)


def _random_stage(seed: int, layout: str | None, threads: int, rng: np.random.Generator) -> SceneTracer:
    names = list(LAYOUTS)
    # Drawn by seed alone: were it redrawn at each attempt, the kinds that pass the pilot easily would take over.
    share = [LAYOUTS[name][0] for name in names]
    name = layout or str(np.random.default_rng(seed).choice(names, p=np.array(share) / sum(share)))
    stage = Stage(rng)
    LAYOUTS[name][1](stage)
    return StageTracer(stage, threads)


def render_and_write(options: RenderOptions, seed: int) -> str:
    """Render and write the example of `seed`; a line that says how it came out. Runs in a worker, too."""
    shot = render_example(seed, options.settings, options.scene, threads_per_worker(options))
    stem = example_stem(options.outdir, seed)
    write_example(stem, shot)
    about = shot.about
    return (f"{stem.name}: {about['kind']}, {', '.join(about['tags'])}, relMSE {about.get('relmse8', 0):.3f}, "
            f"energy {about['energy']:.3f}, attempt {about['attempt'] + 1}")


def threads_per_worker(options: RenderOptions) -> int:
    """The threads asked for, or an equal share of the cores this process may use."""
    return options.threads or max(1, usable_cores() // options.workers)


def render_scenes(options: RenderOptions, progress_kind: ProgressKind = "auto",
                  report: Callable[[str], None] | None = None) -> JobReport[str]:
    """Render every example of the options that is not there yet, then a contact sheet of all.

    An example is NAME.deep.exr, NAME.ref.exr, with the setting `halves` NAME.ref2.exr, and NAME.json; its JSON comes
    last and marks it complete, so a job that was stopped goes on where it was. `report` is told each example's line;
    the progress's notes by default.
    Raises UsageError for settings or a scene that differ from those of examples already there, InputError for a bad
    scene file.
    """
    _check(options)
    seeds = range(options.seed, options.seed + options.count)
    digest = scene_digest(options.scene) if options.scene is not None else None
    missing = [seed for seed in seeds if not _is_complete(options, seed, digest)]
    with make_progress(progress_kind, len(missing)) as progress:
        if len(missing) < len(seeds):
            progress.note(f"{len(seeds) - len(missing)} of {len(seeds)} examples are there already")
        here = partial(render_and_write, options)
        workers = min(options.workers, len(missing))
        with worker_pool(workers, here, missing) if workers > 1 else nullcontext(here) as render:
            def work(seed: int, progress: Progress) -> str:
                line = render(seed)
                (report or progress.note)(line)
                return line

            done = run_frames(missing, work, progress, lambda seed: example_stem(options.outdir, seed).name,
                              here=workers <= 1)
    complete = [example_stem(options.outdir, seed) for seed in seeds if _is_complete(options, seed, digest)]
    if options.contact_sheet and complete:
        write_contact_sheet(options.outdir / CONTACT_SHEET, complete)
    return done


def _check(options: RenderOptions) -> None:
    load_mitsuba(threads_per_worker(options) if options.workers <= 1 else 1)
    if options.contact_sheet:
        load_pillow()
    if options.settings.size % 4 or options.settings.size < 16:
        raise UsageError(f"a size of {options.settings.size} pixels: give a multiple of 4, at least 16")
    if options.scene is not None and options.settings.layout is not None:
        raise UsageError("--layout chooses among the random scenes, which --scene replaces: give one of the two")
    if options.scene is not None and not options.scene.is_file():
        raise InputError(f"{options.scene}: no such scene file")
    if options.settings.layout not in (None, *LAYOUTS):
        raise UsageError(f"no layout {options.settings.layout!r}; there are {', '.join(LAYOUTS)}")
    if options.outdir.exists() and not options.outdir.is_dir():
        raise UsageError(f"{options.outdir}: is a file; name a folder for the examples")
    options.outdir.mkdir(parents=True, exist_ok=True)


def _is_complete(options: RenderOptions, seed: int, digest: str | None) -> bool:
    """Whether the example is there. Raises UsageError when it is, but rendered otherwise, or of a scene file of another
    `digest`; an example that names none has that of its scene file's name. One that lacks but the other half of its
    reference is not there, one that has it and need not is."""
    stem = example_stem(options.outdir, seed)
    *_, about_path = files = example_files(stem)
    if not all(path.exists() for path in files):
        return False
    try:
        about: dict[str, Any] = json.loads(about_path.read_text())
        rendered, rendered_of = (about.get("scene"), _but_halves(about["settings"])), about.get("scene_digest", digest)
    except (ValueError, AttributeError, KeyError, TypeError) as error:
        raise InputError(f"{about_path}: is not an example's JSON; delete it to render the example again") from error
    if rendered != (options.scene and options.scene.name, _but_halves(asdict(options.settings))):
        raise UsageError(f"{about_path}: was rendered with other settings; choose another folder or other seeds")
    if rendered_of != digest:
        raise UsageError(f"{about_path}: was rendered of {options.scene} before that changed, or of another file of "
                         f"its name; choose another folder or other seeds")
    # The JSON comes last: it knows of a half that is there whole.
    halves = about["settings"].get("halves", False) and all(path.exists() for path in example_files(stem, True))
    return halves or not options.settings.halves


def _but_halves(settings: dict[str, Any]) -> dict[str, Any]:
    """What decides everything but whether there is a second reference."""
    return {name: value for name, value in settings.items() if name != "halves"}
