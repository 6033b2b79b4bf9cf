#!/usr/bin/env bash
# One chunk of a shot on a farm: frames FIRST to LAST, with the exposure of one frame KEY that all chunks share.
#
#     examples/farm_chunk.sh IN OUT FIRST LAST KEY [OPTION...]
#     examples/farm_chunk.sh 'noisy.####.exr' 'beauty.####.exr' 1011 1020 1001
#
# A job by itself measures the exposure on its first frame. Chunks would each measure on another frame, and the picture
# could step at their borders; --exposure-from takes the same frame for all, also for the number of layers and the roles
# that say nothing. The frame KEY must be on disk, whether or not it belongs to the chunk, and so must all of FIRST to
# LAST: where one is missing the task ends with 3 and writes none, so make it depend on the renders of all of them.
#
# OpenCue    the command of a layer:   farm_chunk.sh IN OUT #FRAME_START# #FRAME_END# 1001
# Deadline   the arguments of a CommandLine job:   IN OUT <STARTFRAME> <ENDFRAME> 1001
# OpenJD     a step's script:   LBMC_PROGRESS=openjd farm_chunk.sh IN OUT {{Task.Param.First}} {{Task.Param.Last}} 1001
#
# Progress is written as whole lines, `Progress: 42%`, often enough for a watchdog that kills silent tasks; with
# LBMC_PROGRESS=openjd as `openjd_progress: 42`. Errors are lines that start `ERROR:`. Set LBMC_THREADS, LBMC_MEMORY and
# LBMC_DEVICE to what the farm reserved for the task.
set -euo pipefail

if [ $# -lt 5 ]; then
    echo "usage: $0 IN OUT FIRST LAST KEY [OPTION...]" >&2
    exit 2
fi
in=$1 out=$2 first=$3 last=$4 key=$5
shift 5

export LBMC_PROGRESS=${LBMC_PROGRESS:-plain}
# A task that is tried again finds some of its frames written: those are whole, and skipped.
exec lbmc denoise "$in" "$out" --frames "$first-$last" --exposure-from "$key" --skip-existing "$@"
