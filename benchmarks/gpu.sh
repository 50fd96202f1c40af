#!/usr/bin/env bash
# What a GPU that is lent for minutes is for, on a machine with PyTorch, Triton and Lightning but no network.
#   benchmarks/gpu.sh 1 [seconds]   GPU tests, then benchmarks, with a table at the end
#   benchmarks/gpu.sh 2 [seconds]   trains the demo prior, and the paper's (joint, conditioning=rendered)
# Both take 420 seconds unless told otherwise, and leave everything in $OUT (default: benchmarks/results/gpu), in files
# of at most 15 MiB. What is first in a part is most important; each step has its share of the time that is left then,
# and what fails or is stopped keeps nothing else from running.
#
# Wheels that such machines lack: benchmarks/gpu_wheels.sh collects them in .whl. Part 2 reads scenes from
# $PACKS/cars.zip (default: .gpu; made by benchmarks/pack_scenes.py). TINY=1: sizes of seconds, to try it on a CPU.
set -u
cd "$(dirname "$0")/.."
case ${1:-} in 1 | 2) ;; *) echo "usage: benchmarks/gpu.sh 1|2 [seconds]" >&2; exit 2 ;; esac
part=$1 end=$((SECONDS + ${2:-420}))
export OUT=${OUT:-$PWD/benchmarks/results/gpu} PACKS=${PACKS:-.gpu} PYTHONUNBUFFERED=1 OMP_NUM_THREADS=${OMP_NUM_THREADS:-4}
work=$(mktemp -d) python=${PYTHON:-python3} tiny=${TINY:-}
mkdir -p "$OUT" "$work/site" "$work/results"
trap 'rm -rf "$work"' EXIT
say() { echo "[$SECONDS s] $*"; }
left() { echo $((end - SECONDS)); }

if compgen -G ".whl/*.whl" > /dev/null; then
    $python -m pip install -q --no-index --no-deps --no-compile --no-cache-dir --target "$work/site" .whl/*.whl
fi
export PYTHONPATH=$PWD/src:$work/site${PYTHONPATH:+:$PYTHONPATH}

# step SHARE NAME COMMAND…: at most SHARE of $total of the time that is left
step() {
    local share=$1 name=$2 own=$(($(left) * $1 / total)) status
    shift 2
    total=$((total - share))
    if ((own < 1)); then say "$name: no time left"; return; fi
    say "$name (at most $own s)"
    UNTIL=$(($(date +%s) + own * 3 / 4)) timeout -k 5 "$own" "$@" > "$work/$name.log" 2>&1
    status=$?
    tail -n 40 "$work/$name.log"
    cat "$work/$name.log" >> "$OUT/part$part.log"
    ((status)) && say "$name FAILED: exit status $status"
    return 0
}

part1() {
    local sizes="--model base --seconds 1" objects="--whole --few --steps 4 --extrapolate" budgets="paper fast"
    local benchmarks=${BENCHMARKS:-"render inner_step ngd_object unet training_step"}
    if [ "$tiny" ]; then
        sizes="model.unet.channel_mult=[1,2] model.render.uniform_samples=4 model.render.importance_samples=4"
        sizes+=" --model tiny --size 16 --seconds 0.001 --precision 32-true" budgets=minutes
        objects="--whole --few --steps 2 --extrapolate --sweep views --values 2"
    fi
    local tests="tests/render/test_kernels.py tests/render/test_kernel_backend.py tests/render/test_kernel_agreement.py
        tests/diffusion/test_norm_silu.py tests/fit"
    local jobs=() name budget job
    for name in $benchmarks; do
        if [ "$name" != ngd_object ]; then jobs+=("2 $name"); continue; fi
        for budget in $budgets; do
            [ -f "conf/budget/$budget.yaml" ] && jobs+=("2 $name --budget $budget $objects")
        done
    done
    total=$((3 + 2 * ${#jobs[@]}))
    step 3 tests $python -m pytest -p no:cacheprovider --maxfail=1000 ${WORKERS:+-n $WORKERS} ${TESTS:-$tests}
    for job in "${jobs[@]}"; do
        # shellcheck disable=SC2086
        set -- $job
        benchmark "$1" "$2" $sizes "${@:3}"
    done
    cat "$OUT/table.txt"
}

# benchmark SHARE NAME OPTION…: its rows are in $OUT as soon as it ends
benchmark() {
    local share=$1 name=$2
    shift 2
    # shellcheck disable=SC2016
    step "$share" "$name" bash -c 'exec "$0" "$@" --until $UNTIL' $python "benchmarks/$name.py" "$@" --out "$work/results/$SECONDS"
    compgen -G "$work/results/*" > /dev/null || return 0
    tar -C "$work" -cf "$OUT/results.tar" results
    $python benchmarks/report.py "$work"/results/* > "$OUT/table.txt"
}

# train NAME OVERRIDE…: in the background
train() {
    local name=$1
    shift
    timeout -k 5 "$(($(left) - export_seconds))" $python src/train_resident.py run_name="$name" paths.runs_dir="$work/runs" \
        data.root="$work/cars" data.cache_dir="$work/cache" init="${INIT:-$PWD/assets/demo}" fresh_cdm=true dtype=float16 \
        optimizer.lr=8e-4 minutes="$minutes" data.about="'procedural cars seen from elevations of 0 to 90 degrees'" "$@" > "$work/$name.log" 2>&1
}

part2() {
    # decoding and rendering come before the minutes of training, files are written after them
    local reading=${READING:-75} export_seconds=${EXPORTING:-20} more=() pids=() names=(demo demo_paper)
    $python benchmarks/pack_scenes.py unpack "$PACKS/cars.zip" "$work/cars" || return
    [ "$tiny" ] && more=(steps=2 data.batch_size=2 data.target_views=2 data.train_source_views=2 precision=32-true)
    minutes=$($python -c "print(max(0.05, ($(left) - $reading - $export_seconds) / 60))")
    say "training for $minutes minutes"
    train demo ${more[@]+"${more[@]}"} & pids+=($!)
    train demo_paper part=joint conditioning=rendered data.train_source_views=null ${more[@]+"${more[@]}"} & pids+=($!)
    for number in 0 1; do
        wait "${pids[$number]}" || say "${names[$number]} FAILED: exit status $?"
    done
    for name in "${names[@]}"; do  # each by itself: one that failed leaves what it has
        tail -n 5 "$work/$name.log"
        cat "$work/$name.log" >> "$OUT/part2.log"
        collect "$name"
    done
}

# collect NAME: the exported model, in half precision, and the last averages with the curves
collect() {
    local run=$work/runs/$1 last
    [ -f "$run/model/model.safetensors" ] && tar -C "$run" --transform "s/^model/$1/" -cf "$OUT/$1.tar" model
    [ -d "$run" ] || return
    last=$(cd "$run" && ls -t snapshots/* 2> /dev/null | head -n 2)
    # cat NAME_averages.tar.* | tar x
    tar -C "$run" -cf - $last $(cd "$run" && ls -d tensorboard) | split -d -b 15M - "$OUT/$1_averages.tar."
    say "$1 collected"
}

"part$part"
say done
ls -l "$OUT"
