#!/bin/bash
# Measure what a GPU does for the trainer, in eight minutes: gpu.sh DIRECTORY
#
# The directory gets tests.txt, bench.json, and the records of 30 trainings, 16 at a time: PHIL-TD3
# as in the paper's table, and with four and sixteen updates a step. Called again, it goes on.
set -eu
out=$(realpath -m "${1:?the directory that gets what is measured}")
python=${PYTHON:-.venv/bin/python}
began=$SECONDS
mkdir -p "$out"
export OMP_NUM_THREADS=1 CUDA_MPS_PIPE_DIRECTORY=$out/mps CUDA_MPS_LOG_DIRECTORY=$out/mps

"$python" -m pytest -q trainer/tests/test_td3.py trainer/tests/test_bench.py > "$out/tests.txt" || true
tail -n 1 "$out/tests.txt"
[ -f "$out/bench.json" ] || "$python" -m trainer bench --device cuda --out "$out/bench.json"

mkdir -p "$out/mps"
nvidia-cuda-mps-control -d
trap 'echo quit | nvidia-cuda-mps-control' EXIT
train() {  # NAME SETTING
	left=$(((480 - SECONDS + began) / 60))
	[ "$left" -gt 0 ] || return 0
	"$python" -m trainer experiment "$1" --algorithm phil_td3 --setting "$2" --device cuda \
		--jobs 16 --max-minutes "$left" --results "$out/results/$1" --runs "$out/runs/$1"
}
train all normal
train guidance four_updates
train guidance sixteen_updates
