#!/usr/bin/env bash
# Denoises the examples into a folder, measures each against its reference, and draws a panel of it.
#   examples/demo.sh [OUT]          OUT: build/demo by default
set -euo pipefail
examples=$(cd "$(dirname "$0")" && pwd)
out=${1:-$examples/../build/demo}
mkdir -p "$out"
out=$(cd "$out" && pwd)

for deep in "$examples"/*.deep.exr; do
  name=$(basename "$deep" .deep.exr)
  echo "== $name"
  lbmc denoise "$deep" "$out/$name.exr" --overwrite
  lbmc compare "$out/$name.exr" "$examples/$name.ref.exr" --panel "$out/$name.png" --overwrite
done
echo "Look at $out/*.png: the denoised picture, its reference, where they differ, and the worst regions close up."
