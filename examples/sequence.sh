#!/usr/bin/env bash
# Denoises the frames of a sequence that are not denoised yet, and says what the exit code means.
#
#     examples/sequence.sh IN OUT FRAMES [OPTION...]
#     examples/sequence.sh 'shot/noisy.####.exr' 'shot/beauty.####.exr' 1001-1100
#     examples/sequence.sh 'shot/noisy.%04d.exr' 'shot/beauty.%04d.exr' 1001-1100x2 --device cuda:0
#
# Quote the patterns: the shell must not touch # and $. Further options go to `lbmc denoise` as they are.
# Frames that exist are left alone, so the script can be run again after an interruption or a failure.
set -euo pipefail

if [ $# -lt 3 ]; then
    echo "usage: $0 IN OUT FRAMES [OPTION...]" >&2
    exit 2
fi
in=$1 out=$2 frames=$3
shift 3

code=0
lbmc denoise "$in" "$out" --frames "$frames" --skip-existing "$@" || code=$?

# What each code asks of a calling script; a dispatcher on a farm decides in the same way whether to try again. A frame
# of FRAMES that is not on disk ends the whole job with 3 before anything is written, whatever the others are.
case $code in
    0) echo "all frames of $frames are there" ;;
    1) echo "some frames failed (listed above); the others are written: mend the inputs, or make room on the disk," \
            "and run this again" >&2 ;;
    2) echo "the options are wrong or an output was refused: trying again will not help" >&2 ;;
    3) echo "nothing was written: a frame or the folder of OUT is missing, or no input is suitable (see above): mend" \
            "that before this is run again" >&2 ;;
    130 | 143) echo "stopped by a signal; whole frames are kept, no partial file is left: run this again" >&2 ;;
esac
exit "$code"
