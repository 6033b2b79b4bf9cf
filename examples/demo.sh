#!/usr/bin/env bash
# Denoises the two examples with the installed `lbmc`, measures them against their references, and draws the result.
#
#     examples/demo.sh [FOLDER]        `make demo` runs this; FOLDER is build/demo unless given
#
# FOLDER gets, for each example, NAME.exr (the denoised beauty) and NAME.png (noisy | denoised | reference, with crops).
# Needs `lbmc` and `python3` of one installation on PATH, and matplotlib for the pictures.
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
folder=${1:-$(dirname "$here")/build/demo}

mkdir -p "$folder"
for deep in "$here"/scenes/*.deep.exr; do
    name=$(basename "$deep" .deep.exr)
    echo "== $name: lbmc denoise"
    lbmc denoise "$deep" "$folder/$name.exr" --overwrite
    echo "== $name: lbmc compare with the reference"
    lbmc compare "$folder/$name.exr" "$here/scenes/$name.ref.exr" --no-flip
    echo
done

echo "== noisy, denoised and reference side by side"
for deep in "$here"/scenes/*.deep.exr; do
    name=$(basename "$deep" .deep.exr)
    python3 "$here/panel.py" "$folder/$name.png" "$deep" "$folder/$name.exr" "$here/scenes/$name.ref.exr"
done
