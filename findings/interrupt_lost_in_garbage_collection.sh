#!/usr/bin/env bash
# Once jax is imported, a Ctrl-C that arrives during a garbage collection is lost: the program goes on.
#
# jax 0.10.1, jaxlib 0.10.1, numpy 2.4.0 (CPython 3.11 or newer).
#
# One would guess: SIGINT becomes a KeyboardInterrupt in the main thread, whatever that is doing.
# What happens: jax has a Python function among gc.callbacks. A signal that comes while Python collects is handled at the
# first bytecode after it, which is in that callback; exceptions there are printed ("Exception ignored in ...") and
# dropped. While a large program is traced much of the time goes into collections, and so does that share of all Ctrl-C.
# Without jax the same program is interrupted.
#
# Output seen:
#   without jax: interrupted
#   with jax: went on
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet jax==0.10.1 jaxlib==0.10.1 numpy==2.4.0
cat > "$folder/program.py" <<'PYTHON'
import gc, os, signal, sys, threading, time

if "jax" in sys.argv:
    import jax
heap = [[i] for i in range(5_000_000)]  # so that a collection takes a while
signal.signal(signal.SIGINT, signal.default_int_handler)
threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    began = time.monotonic()
    gc.collect()
    assert time.monotonic() - began > 0.15, "the collection was over before the signal"
    time.sleep(1)
    print("went on")
except KeyboardInterrupt:
    print("interrupted")
PYTHON
without=$("$folder/venv/bin/python" "$folder/program.py")
with=$("$folder/venv/bin/python" "$folder/program.py" jax 2>/dev/null)
echo "without jax: $without"
echo "with jax: $with"
[ "$without" = interrupted ] && [ "$with" = "went on" ]
