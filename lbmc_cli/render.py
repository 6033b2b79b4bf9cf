"""`lbmc render`: random scenes, or views of a scene file, as training examples."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lbmc_cli.options import PROGRESS, THREAD_COUNT, LbmcCommand, option
from lbmc_cli.report import end_job


@click.command(cls=LbmcCommand)
@click.argument("outdir", type=click.Path(path_type=Path))
@option("--count", type=click.IntRange(1), default=16, show_default=True, help="Examples to render.")
@option("--seed", type=click.IntRange(0), default=1, show_default=True, help="First seed; each example has its own.")
@option("--samples", type=click.IntRange(1), default=32, show_default=True, help="Path samples stored per pixel.")
@option("--reference", type=click.IntRange(1), default=128, show_default=True, help="Reference paths per pixel.")
@option("--halves", is_flag=True, help="Another reference of as many paths, NAME.ref2.exr: bench and train use both.")
@option("--size", type=click.IntRange(16), default=192, show_default=True, help="Pixels along a side.")
@option(
    "--scene",
    type=click.Path(path_type=Path),
    metavar="FILE.xml",
    help="Views of this Mitsuba scene, with random cameras, lenses and motion, in place of random scenes.",
)
@option("--layout", metavar="NAME", help="Only interior, outdoor, tabletop, floating, abstract or bright scenes.  "
        "[default: a mix of the first four]")
@option("--defocus/--no-defocus", default=None, help="Defocus in every scene, or in none.  [default: in half]")
@option("--motion/--no-motion", default=None, help="Motion in every scene, or in none.  [default: in half]")
@option("--workers", type=THREAD_COUNT, default=1, show_default=True, help="Processes that render side by side.")
@option("--threads", type=THREAD_COUNT, metavar="N", help="Threads per worker.  [default: share the cores]")
@option("--contact-sheet/--no-contact-sheet", default=True, help="Write contact-sheet.png to look at.  [default: yes]")
@PROGRESS
def render(
    outdir: Path,
    count: int,
    seed: int,
    scene: Path | None,
    workers: int,
    threads: int | None,
    contact_sheet: bool,
    progress: Any,
    **settings: Any,
) -> int:
    """Render training examples into the folder OUTDIR: NAME.deep.exr, NAME.ref.exr and NAME.json each.

    Needs LLVM 17 or newer, and Mitsuba 3, which comes with the extra 'render' of lbmc. Examples that are there already
    are kept, so a job that was stopped goes on where it was; the same seed gives the same example.
    """
    from pipelines.rendering.job import RenderOptions, render_scenes
    from pipelines.rendering.shots import RenderSettings

    options = RenderOptions(outdir, count, seed, RenderSettings(**settings), scene, workers, threads, contact_sheet)
    return end_job(render_scenes(options, progress))
