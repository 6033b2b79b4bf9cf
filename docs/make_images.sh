#!/usr/bin/env bash
# Draws docs/images/examples.png, the README's picture, with the installed `lbmc` and its default weights.
set -euo pipefail

home=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

files=()
for name in interior defocus-motion; do
    scene=$home/examples/scenes/$name
    lbmc denoise "$scene.deep.exr" "$folder/$name.exr" --pixel-type float
    files+=("$scene.deep.exr" "$folder/$name.exr" "$scene.ref.exr")
done
python3 "$home/examples/panel.py" "$home/docs/images/examples.png" "${files[@]}"
