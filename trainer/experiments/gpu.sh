#!/bin/bash
# Measure what a GPU does for the trainer, in eight minutes: gpu.sh DIRECTORY
#
# The directory gets tests.txt, bench.json, and the records of 36 trainings, at most 16 at a time:
# PHIL-TD3 as in the paper's table, and with four and sixteen updates a step. A part that fails does
# not stop the others; the status is then 1. A second call resumes. Without MPS there is a file
# without_mps.
set -u
out=$(realpath -m "${1:?the directory for the results}")
python=${PYTHON:-.venv/bin/python}
failed=0 SECONDS=0
mkdir -p "$out" || exit
export OMP_NUM_THREADS=1

timeout -s INT 90 "$python" -m pytest -q -k "gpu or recorded" trainer/tests/test_{td3,bench,training}.py \
	> "$out/tests.txt" 2>&1 || failed=1
tail -n 1 "$out/tests.txt"
[ -f "$out/bench.json" ] ||
	timeout 180 "$python" -m trainer bench --device cuda --out "$out/bench.json" || failed=1

# MPS lets processes compute side by side; without it they take turns.
mps=$(mktemp -d)  # A short path, as a socket's must be
trap 'echo quit -t 10 | CUDA_MPS_PIPE_DIRECTORY=$mps nvidia-cuda-mps-control; rm -r "$mps"' EXIT
export CUDA_MPS_PIPE_DIRECTORY=$mps CUDA_MPS_LOG_DIRECTORY=$mps
nvidia-cuda-mps-control -d && "$python" -c 'import torch; torch.zeros(1, device="cuda")' ||
	{ unset CUDA_MPS_PIPE_DIRECTORY && touch "$out/without_mps"; }

train() {  # NAME SETTING...
	left=$(((480 - SECONDS) / 60))
	[ "$left" -gt 0 ] || { failed=1 && return; }
	"$python" -m trainer experiment "$1" --algorithm phil_td3 --setting "${@:2}" --device cuda \
		--jobs 16 --max-minutes "$left" --results "$out/results/$1" --runs "$out/runs/$1" || failed=1
}
train all normal --seeds 8  # 16 at once
train guidance four_updates sixteen_updates
exit $failed
