#!/usr/bin/env python3
"""Reproduces the README's table and plot: `lbmc bench` on the examples, compared with results.json in the repository.

    python benchmarks/readme.py [--out build/bench] [--threads 1]
    python benchmarks/readme.py --keep      also makes its results the repository's: results.json, charts and tables
    python benchmarks/readme.py --keep --scenes watched=FOLDER --scenes shared=FOLDER [--work WORK]
        also all else in docs/results.md that changes with the weights: error by samples on scenes of 32, what the
        layers do, the pictures of layers (WORK is where benchmarks/paper.py left its networks)

Ends with 1 where an error differs from the repository's by more than 1e-3 of itself. Times are another matter: what
should agree is their ratio to OIDN's in the same run, and where it does not within a quarter, that is said. A run in
which something failed also ends with 1; it says what, and is not kept.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs"))

import figures
from scripts import run_script

from deep_io.errors import LbmcError
from pipelines.bench.job import RESULTS, bench
from pipelines.bench.options import BenchOptions
from pipelines.bench.results import Results
from pipelines.progress import ProgressKind

HOME = Path(__file__).resolve().parents[1]
KEPT = HOME / "results.json"
ERROR, TIME = 1e-3, 0.25
"""Relative differences that are agreement."""
MANY, SAMPLES = "*.32spp", HOME / "docs" / "results" / "samples.json"
"""Scenes with many samples per pixel, and where the results on them are kept."""
YARDSTICK = "OIDN + albedo, normal"


def differing_errors(found: Results, kept: Results) -> Iterator[str]:
    """A line for every error that is not the repository's, and for what only one of the two has."""
    mine, theirs = ({(row.scene, row.method): row.scores for row in results.measurements if row.scores}
                    for results in (found, kept))
    for key in sorted(mine.keys() ^ theirs.keys()):
        yield f"{key[1]} on {key[0]}: only {'here' if key in mine else 'in results.json'}"
    for key in sorted(mine.keys() & theirs.keys()):
        for name, value in mine[key].items():
            other = theirs[key].get(name)
            if value is None and other is None:
                continue
            if value is None or other is None or abs(value - other) > ERROR * abs(other):
                yield f"{key[1]} on {key[0]}: {name} is {value}, in results.json {other}"


def differing_times(found: Results, kept: Results) -> Iterator[str]:
    """A line for every method whose time, as a share of OIDN's in the same run, is not the repository's."""
    mine, theirs = (ratios(results) for results in (found, kept))
    for name in mine.keys() & theirs.keys():
        if abs(mine[name] / theirs[name] - 1.0) > TIME:
            yield f"{name}: {mine[name]:.2f} times the CPU time of {YARDSTICK}, in results.json {theirs[name]:.2f}"


def ratios(results: Results) -> dict[str, float]:
    """CPU time of each method's own work over OIDN's; empty without OIDN."""
    summary = results.summary(results.groups()[0])
    base = summary[YARDSTICK].own_cpu if YARDSTICK in summary else 0.0
    idle = {YARDSTICK, *(spec.name for spec in results.methods if spec.family == "input")}
    return {name: row.own_cpu / base for name, row in summary.items() if base and row.own_cpu and name not in idle}


def keep(found: Results, source: Path, target: Path) -> bool:
    """Puts results in the repository, unless something failed in them: then that is said, and those there stay."""
    missing = found.missing()
    if missing:
        print(f"ERROR: {source}: not kept as {target}, since something failed; mend it and run again:", file=sys.stderr)
        print("\n".join(f"  {name}: {why}" for name, why in missing.items()), file=sys.stderr)
        return False
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(source, target)
    return True


def refresh(scenes: list[str], work: Path | None, threads: int, progress: ProgressKind) -> bool:
    """What docs/results.md has from scenes that are not part of the repository. Whether all of it could be kept."""
    kept = True
    for word in scenes:
        folder = Path(word.partition("=")[2])
        if not any(folder.glob(f"{MANY}.deep.exr")):
            continue
        with tempfile.TemporaryDirectory() as out:
            found = bench(BenchOptions(folder, Path(out), match=MANY, threads=threads, repeats=1, frame=0, paper=False,
                                       savings=False, memory=False, growth=(), flip=False, progress=progress))
            kept &= keep(found, Path(out) / RESULTS, SAMPLES)
    run_script("benchmarks/layers_alive.py", *scenes)
    run_script("docs/layer_images.py", *(() if work is None else ("--work", work)))
    return kept


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=HOME / "build" / "bench")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--progress", choices=("auto", "bar", "plain", "none"), default="auto")
    parser.add_argument("--keep", action="store_true", help="make these results the repository's")
    parser.add_argument("--scenes", action="append", default=[], metavar="NAME=FOLDER")
    parser.add_argument("--work", type=Path)
    options = parser.parse_args()
    kept = figures.load(KEPT) if KEPT.exists() else None
    begun = time.monotonic()
    progress: ProgressKind = options.progress
    found = bench(BenchOptions(HOME / "examples" / "scenes", options.out, threads=options.threads, overwrite=True,
                               progress=progress))
    print((options.out / "results.md").read_text("utf-8"))
    figures.save({"speed": figures.speed(found), "growth": figures.growth(found)}, options.out)
    print(f"{(time.monotonic() - begun) / 60:.1f} minutes; report: {options.out / 'report.html'}")
    code = int(bool(found.missing()))
    if kept is not None:
        errors, times = list(differing_errors(found, kept)), list(differing_times(found, kept))
        print("\n".join(errors) or f"every error agrees with results.json within {ERROR:g}")
        print("\n".join(times) or f"every time agrees with results.json within {TIME:.0%}, as a share of OIDN's")
        code |= int(bool(errors))
    if options.keep and keep(found, options.out / RESULTS, KEPT):
        code = 0
        if options.scenes:
            code = int(not refresh(options.scenes, options.work, options.threads, progress))
        run_script("docs/figures.py")
        run_script("docs/tables.py", "--write")
    return code


if __name__ == "__main__":
    try:
        sys.exit(main())
    except LbmcError as error:
        sys.exit(f"ERROR: {error}")
