#!/usr/bin/env bash
# From flat one-sample renders to a denoised beauty and denoised deep layers, for renderers that write no deep samples.
#
#     examples/pack_denoise_export.sh FOLDER RENDER...
#     examples/pack_denoise_export.sh out shot.s1.exr shot.s2.exr shot.s3.exr shot.s4.exr
#
# Each RENDER is the same frame at one sample per pixel with another seed, pixel filter box, the AOVs in the same file.
# FOLDER gets samples.deep.exr (the renders as one deep sample file: any deep reader flattens it to their mean),
# beauty.exr (flat, denoised) and layers.deep.exr (denoised layers: front-to-back over gives beauty.exr again).
set -euo pipefail

if [ $# -lt 3 ]; then
    echo "usage: $0 FOLDER RENDER RENDER..." >&2
    exit 2
fi
folder=$1
shift

mkdir -p "$folder"
lbmc pack "$@" "$folder/samples.deep.exr" --overwrite
lbmc denoise "$folder/samples.deep.exr" "$folder/beauty.exr" --overwrite
lbmc export-layers "$folder/samples.deep.exr" "$folder/layers.deep.exr" --form deep --overwrite
ls -l "$folder"
