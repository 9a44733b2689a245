"""Damaged files over every reader, in guarded children: what is not refused in words, dies, hangs or swells is told.

``python tests/reader_fuzzing.py --files 100000 --seed 1`` damages good files, the same ones for a seed, and prints a
line for each reader; exit code 1 where a file was not survived. A reader is added by a line in `fuzzed_readers` or,
for what musclefit itself wrote, `fuzzed_results`.
"""

from __future__ import annotations

import argparse
import gzip
import random
import re
import resource
import select
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from fuzzed_readers import READERS as FOREIGN
from fuzzed_readers import Reader
from fuzzed_results import READERS as OWN

READERS = (*FOREIGN, *OWN)
CPU_S = 5.0
"""Longest time that a file may take, CPU seconds."""
SILENT_S = 120.0
"""A child that says nothing for so long, seconds on the clock, hangs."""
PREPARING_S = 900.0
"""The same while it makes its good files."""
MEMORY_BYTES = 1 << 30
"""What reading a file may take beyond what the child has when it starts."""

# How files are damaged

WORDS = (
    *(b"0", b"-1", b"1", b"2", b"1e308", b"-1e308", b"1e-320", b"nan", b"inf", b"-inf", b"", b"1e999"),
    *(str(n).encode() for n in (2**7, 2**15, 2**31, 2**31 - 1, 2**32, 2**63, 2**63 - 1, -(2**63), 2**64, 10**30)),
    *(b"9" * 400, b"9" * 5000, b"0x10", b"1_0", b"\xc3\xa9", b"\xe9", b"\x00", b"true", b"null", b"[]", b"{}", b'"'),
)
NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def damaged(data: bytes, chance: random.Random) -> bytes:
    """The bytes with one to four faults; those of a packed file mostly within what is packed."""
    if data[:2] == b"\x1f\x8b" and chance.random() < 0.6:
        return gzip.compress(damaged(gzip.decompress(data), chance), 1)
    for _ in range(chance.randint(1, 4)):
        data = chance.choice(FAULTS)(data, chance)
    return data


def _flip(data: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(data) or 1)
    return data[:at] + bytes([chance.randrange(256)]) + data[at + 1 :]


def _cut(data: bytes, chance: random.Random) -> bytes:
    return data[: chance.randrange(len(data) + 1)]


def _span(data: bytes, chance: random.Random) -> tuple[int, int]:
    begin = chance.randrange(len(data) + 1)
    return begin, min(len(data), begin + chance.choice((1, 2, 8, 40, 300)))


def _leave_out(data: bytes, chance: random.Random) -> bytes:
    begin, end = _span(data, chance)
    return data[:begin] + data[end:]


def _double(data: bytes, chance: random.Random) -> bytes:
    begin, end = _span(data, chance)
    return data[:end] + data[begin:end] * chance.choice((1, 1, 3, 100)) + data[end:]


def _noise(data: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(data) + 1)
    return data[:at] + chance.randbytes(chance.choice((1, 4, 50))) + data[at:]


def _number(data: bytes, chance: random.Random) -> bytes:
    found = list(NUMBER.finditer(data[:20000]))
    if not found:
        return _integer(data, chance)
    word = chance.choice(found)
    return data[: word.start()] + chance.choice(WORDS) + data[word.end() :]


def _integer(data: bytes, chance: random.Random) -> bytes:
    size = chance.choice((2, 4, 8))
    at = chance.randrange(max(len(data) - size, 0) + 1)
    value = chance.choice((0, 1, -1, 2**15, 2**31 - 1, -(2**31), 2**32 - 1, 2**63 - 1, 2**62, 7, 1000))
    return data[:at] + (value % 2 ** (8 * size)).to_bytes(size, chance.choice(("little", "big"))) + data[at + size :]


def _real(data: bytes, chance: random.Random) -> bytes:
    kind = chance.choice(("<f4", "<f8", ">f4", ">f8"))
    with np.errstate(over="ignore"):
        word = np.array(chance.choice((np.nan, np.inf, 1e308, 1e38, 1e-310, -1.0)), dtype=kind).tobytes()
    at = chance.randrange(max(len(data) - len(word), 0) + 1)
    return data[:at] + word + data[at + len(word) :]


def _lines(data: bytes, chance: random.Random) -> bytes:
    lines = data.split(b"\n")
    a, b = chance.randrange(len(lines)), chance.randrange(len(lines))
    if chance.random() < 0.5:
        lines[a], lines[b] = lines[b], lines[a]
    else:
        lines.insert(a, lines[b])
    return b"\n".join(lines)


def _nest(data: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(data) + 1)
    return data[:at] + chance.choice((b"[", b"{", b'{"a":', b"<a>", b'"', b"x" * 200)) * 1000 + data[at:]


FAULTS = (_flip, _flip, _cut, _leave_out, _double, _noise, _number, _number, _number, _integer, _real, _lines, _nest)


def fuzzed(reader: Reader, *, seed: int, number: int) -> bytes:
    """The damaged file of a number: the same for each seed."""
    chance = random.Random(f"{seed}/{reader.name}/{number}")
    return damaged(chance.choice(_examples(reader)), chance)


@cache
def _examples(reader: Reader) -> list[bytes]:
    return reader.examples()


# The child, and who watches it


def survive(reader: Reader, data: bytes, folder: Path) -> str:
    """Read a file; "" where it was read or refused in words, else what went wrong."""
    from musclefit.errors import MusclefitError

    path = folder / f"file{reader.ending}"
    path.write_bytes(data)
    began = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            reader.read(path)
    except MusclefitError:
        pass
    except MemoryError:
        return "over 1 GiB"
    except Exception as error:  # what no reader may let through
        place = traceback.extract_tb(error.__traceback__)[-1]
        return f"uncaught {type(error).__name__}: {str(error)[:120]} ({Path(place.filename).name}:{place.lineno})"
    took = time.process_time() - began
    return f"over {CPU_S:g} s ({took:.1f} s)" if took > CPU_S else ""


def _child(name: str, seed: int, begin: int, end: int) -> None:
    reader = next(r for r in READERS if r.name == name)
    _examples(reader)
    with tempfile.TemporaryDirectory() as folder:
        survive(reader, _examples(reader)[0], Path(folder))  # imports what it needs before memory is counted
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY_BYTES,) * 2)
        for number in range(begin, end):
            print(f"{number}", flush=True)
            problem = survive(reader, fuzzed(reader, seed=seed, number=number), Path(folder))
            if problem:
                print(f"{number} {problem}", flush=True)
    print("done", flush=True)


@dataclass
class Outcome:
    """What a reader survived: how many files, and those that it did not, by their number."""

    files: int = 0
    cpu_s: float = 0.0
    problems: dict[int, str] = field(default_factory=dict)


def campaign(reader: Reader, *, files: int, seed: int) -> Outcome:
    """Have children read the damaged files numbered from 0, a new child after each death or hang."""
    outcome, begin = Outcome(files), 0
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    while begin < files:
        asked = ["--child", reader.name, "--seed", str(seed), "--range", str(begin), str(files)]
        command = [sys.executable, __file__, *asked]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
            last, done = begin - 1, False
            for line in _said(child):
                word, _, problem = line.partition(" ")
                done = word == "done"
                if word.isdigit():
                    last = int(word)
                if problem:
                    outcome.problems[last] = problem
            if done:
                break
            hung = child.poll() is None
            child.kill()
            last_words = child.stderr.read()[-300:].strip() if child.stderr else ""
            outcome.problems[max(last, 0)] = "hung" if hung else f"died with code {child.wait()}: {last_words}"
            begin = last + 1
            if last < 0:
                raise RuntimeError(f"{reader.name}: no good file could be read: {last_words}")
    outcome.cpu_s = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
    return outcome


def _said(child: subprocess.Popen[str]) -> Iterator[str]:
    """The lines of a child, until it ends or is silent for too long."""
    assert child.stdout is not None
    patience_s = PREPARING_S
    while select.select([child.stdout], [], [], patience_s)[0]:
        line, patience_s = child.stdout.readline(), SILENT_S
        if not line:
            child.wait()
            return
        yield line.strip()


def main() -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=2700, help="over all readers together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--reader", default="", help="only readers whose name holds this")
    parser.add_argument("--child", default="", help=argparse.SUPPRESS)
    parser.add_argument("--range", type=int, nargs=2, default=(0, 0), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        _child(given.child, given.seed, *given.range)
        return 0
    chosen = [reader for reader in READERS if given.reader in reader.name]
    total, failed = 0, 0
    for reader in chosen:
        outcome = campaign(reader, files=-(-given.files // len(chosen)), seed=given.seed)
        total, failed = total + outcome.files, failed + len(outcome.problems)
        print(f"{reader.name}: {outcome.files} files, {len(outcome.problems)} not survived, {outcome.cpu_s:.0f} CPU s")
        for number, problem in sorted(outcome.problems.items())[:20]:
            print(f"    {number}: {problem}", flush=True)
    print(f"seed {given.seed}: {total} files over {len(chosen)} readers, {failed} not survived")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
