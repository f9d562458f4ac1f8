#!/usr/bin/env bash
# What the learner does on a GPU: gradient steps against the CPU's, gradients against float64, and a
# short training with learner.device: cuda. Needs `make setup` and a GPU that torch finds.
set -eo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. ./env.sh
python -m benchmarks.gpu_learner
folder="$(mktemp -d)"
trap 'rm -r "$folder"' EXIT
crash-coach train buttons/qmix --out "$folder/run" --seed 1 \
    --set total_steps=4000 test_interval_steps=2000 test_episodes=8 learner.device=cuda
crash-coach evaluate "$folder/run" --episodes 8
