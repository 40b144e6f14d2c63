#!/bin/sh
# The CPU kernels' tests under AddressSanitizer and UndefinedBehaviorSanitizer. Usage: worker/sanitize/run.sh [pytest arguments]
# PYTHON picks the interpreter (default: python); it must have the project and its test tools installed. ISAS picks the builds
# (default: the best that this processor runs; the baseline takes many minutes to compile with checks).
set -eu
root=$(cd "$(dirname "$0")/../.." && pwd)
python=${PYTHON:-python}
build=$root/worker/build/sanitize
isas=${ISAS:-$("$python" -c 'from splatmill_worker.kernels.cpu.isa import supported; print(supported()[0])')}

cmake -S "$root/worker" -B "$build" -DCMAKE_BUILD_TYPE=Release -DSPLATMILL_SANITIZE=ON \
  -DPython_EXECUTABLE="$("$python" -c 'import sys; print(sys.executable)')" > /dev/null
for isa in $isas; do
  cmake --build "$build" --parallel --target "_cpu_$isa"
done

# Python is not built with the sanitizer, so its runtime has to come first. Leaks are left out: the interpreter's own drown them.
asan=$(c++ -print-file-name=libasan.so)
ubsan=$(c++ -print-file-name=libubsan.so)
cd "$root"
for isa in $isas; do
  echo "== $isa"
  LD_PRELOAD="$asan:$ubsan" \
  ASAN_OPTIONS=detect_leaks=0:halt_on_error=1 UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1 \
  SPLATMILL_CPU_ISA=$isa SPLATMILL_SANITIZED="$build" PYTHONPATH="$root/worker/sanitize" OMP_NUM_THREADS=2 \
    "$python" -m pytest -q -p sanitized -p no:cacheprovider --timeout 600 \
    ${*:-tests/kernels/test_cpu_input.py tests/kernels/test_cpu_step.py}
done
