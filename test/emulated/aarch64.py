"""C functions of this package on an emulated aarch64 processor: compiled by `zig cc`, executed by `unicorn`.

Used by fusion_neon.py.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import struct
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import setuptools
import unicorn
from unicorn import arm64_const as arm64

Argument = int | bytes | np.ndarray | tuple

ZIG = [sys.executable, "-m", "ziglang"]
TARGET = ["-target", "aarch64-linux-musl", "-fPIC"]
LIBM = {"sin": 1, "cos": 1, "atan2": 2, "hypot": 2}  # name -> arguments; answered by this machine
RUNTIME = """
#include <stddef.h>
void* memcpy(void* res, const void* from, size_t n) {
  for (size_t i = 0; i < n; i++) ((char*)res)[i] = ((const char*)from)[i];
  return res;
}
void* memset(void* res, int value, size_t n) {
  for (size_t i = 0; i < n; i++) ((char*)res)[i] = (char)value;
  return res;
}
int strcmp(const char* a, const char* b) {
  while (*a && *a == *b) a++, b++;
  return *a - *b;
}
""" + "".join(f"double {name}(double x) {{ return x; }}\n" for name in LIBM)

PAGE = 1 << 16
STOP, STACK, DATA = 0x1000_0000, 0x2000_0000, 0x4000_0000
STACK_BYTES, DATA_BYTES = 1 << 20, 1 << 26

# What an instruction is: name -> (mask, value) of its encodings.
VECTOR, ELEMENT = 0xFFE0FC00, 0xFFC0F400
DOUBLES = [(VECTOR, 0x4E60CC00), (VECTOR, 0x4EE0CC00), (ELEMENT, 0x4FC01000), (ELEMENT, 0x4FC05000)]
FLOATS = [(mask, value & ~(1 << 22)) for mask, value in DOUBLES]
KINDS = {
    "fmla and fmls of 2 doubles": DOUBLES,
    "fmla and fmls of 4 floats": FLOATS,
    "multiply-add of 1 number": [(0xFF000000, 0x1F000000)],
}


def build(module_name: str, folder: Path) -> Path:
    """Compile what a module of setup.py has without Python, with its flags there; returns a static image."""
    modules = setuptools.distutils.core.run_setup("setup.py", stop_after="init").ext_modules
    module = next(module for module in modules if module.name == module_name)
    runtime, image = folder / "runtime.c", folder / "image"
    runtime.write_text(RUNTIME)
    flags = {name: module.extra_compile_args for name in module.sources if "module" not in Path(name).name}
    flags[str(runtime)] = ["-O1", "-fno-builtin"]  # without -O zig instruments for undefined behaviour
    headers = [f"-I{path}" for path in module.include_dirs if "numpy" not in path]
    for source, options in flags.items():
        output = str(folder / f"{Path(source).stem}.o")
        subprocess.run([*ZIG, "cc", *TARGET, *headers, *options, "-c", source, "-o", output], check=True)
    objects = sorted(map(str, folder.glob("*.o")))
    subprocess.run([*ZIG, "ld.lld", "-static", "-e", "memcpy", *objects, "-o", str(image)], check=True)
    return image


class Machine:
    """A processor with the image in its memory, on which functions can be called."""

    def __init__(self, image: Path) -> None:
        self.uc = unicorn.Uc(unicorn.UC_ARCH_ARM64, unicorn.UC_MODE_ARM)
        self.uc.ctl_set_cpu_model(arm64.UC_CPU_ARM64_A53)
        for start, size in ((STOP, PAGE), (STACK, STACK_BYTES), (DATA, DATA_BYTES)):
            self.uc.mem_map(start, size)
        self.uc.reg_write(arm64.UC_ARM64_REG_CPACR_EL1, 3 << 20)  # floating point is not trapped
        self.symbols = self._load(image.read_bytes())
        for name, count in LIBM.items():
            function = getattr(ctypes.CDLL(ctypes.util.find_library("m")), name)
            function.argtypes, function.restype = [ctypes.c_double] * count, ctypes.c_double
            at = self.symbols[name]
            self.uc.hook_add(unicorn.UC_HOOK_CODE, self._answer, function, begin=at, end=at)

    def _load(self, elf: bytes) -> dict[str, int]:
        """Segments to where they belong; returns the addresses of the symbols."""
        headers, sections = struct.unpack_from("<QQ", elf, 32)
        header_bytes, count, section_bytes, section_count = struct.unpack_from("<4H", elf, 54)
        for n in range(count):
            header = struct.unpack_from("<IIQQQQQ", elf, headers + n * header_bytes)
            kind, _, offset, address, _, size, reserved = header
            if kind == 1:
                first = address // PAGE * PAGE
                self.uc.mem_map(first, -(-(address + reserved - first) // PAGE) * PAGE)
                self.uc.mem_write(address, elf[offset : offset + size])
        tables = [
            struct.unpack_from("<IIQQQQI", elf, sections + n * section_bytes) for n in range(section_count)
        ]
        _, _, _, _, offset, size, link = next(table for table in tables if table[1] == 2)
        names, found = tables[link][4], {}
        for at in range(offset, offset + size, 24):
            name, _, value = struct.unpack_from("<I4sQ", elf, at)
            found[elf[names + name : elf.index(b"\0", names + name)].decode()] = value
        return found

    def _answer(self, uc: unicorn.Uc, address: int, size: int, function: Any) -> None:
        """A function of LIBM, by this machine's."""
        result = function(*(self.real(arm64.UC_ARM64_REG_D0 + n) for n in range(len(function.argtypes))))
        uc.reg_write(arm64.UC_ARM64_REG_D0, *struct.unpack("<Q", struct.pack("<d", result)))
        uc.reg_write(arm64.UC_ARM64_REG_PC, uc.reg_read(arm64.UC_ARM64_REG_LR))

    def real(self, register: int = arm64.UC_ARM64_REG_D0) -> float:
        """A register for real numbers; d0 has a function's result."""
        return struct.unpack("<d", struct.pack("<Q", self.uc.reg_read(register)))[0]

    def read(self, address: int, count: int) -> bytes:
        return bytes(self.uc.mem_read(address, count))

    def run(self, function: int, *args: Argument, outputs: Sequence[np.ndarray] = ()) -> int:
        """Call a function by its address; returns x0. Arrays go as pointers, tuples as pointers to a struct.

        Those among the arrays that are `outputs` get what the function has written there.
        """
        places: dict[int, int] = {}
        self.top = DATA
        for n, arg in enumerate(args):
            self.uc.reg_write(arm64.UC_ARM64_REG_X0 + n, self._put(arg, places))
        self.uc.reg_write(arm64.UC_ARM64_REG_SP, STACK + STACK_BYTES)
        self.uc.reg_write(arm64.UC_ARM64_REG_LR, STOP)
        self.uc.emu_start(function, STOP)
        for array in outputs:
            raw = self.read(places[id(array)], array.nbytes)
            array[...] = np.frombuffer(raw, array.dtype).reshape(array.shape)
        return self.uc.reg_read(arm64.UC_ARM64_REG_X0)

    def _put(self, arg: Argument, places: dict[int, int]) -> int:
        """What a register, or a place of 8 bytes in a struct, has for this argument."""
        if isinstance(arg, int):
            return arg % 2**64
        raw = arg
        if isinstance(arg, tuple):
            raw = struct.pack(f"<{len(arg)}Q", *(self._put(member, places) for member in arg))
        elif isinstance(arg, np.ndarray):
            raw = np.ascontiguousarray(arg).tobytes()
        address, self.top = self.top, self.top + (len(raw) + 127) // 64 * 64
        self.uc.mem_write(address, raw + b"\xff" * 64)  # no number, behind the end
        places[id(arg)] = address
        return address

    def count(self, call: Callable[[], Any]) -> Counter[str]:
        """Executed instructions of KINDS, and of all kinds, of what `call` calls."""
        found: Counter[str] = Counter()

        def see(uc: unicorn.Uc, address: int, size: int, data: None) -> None:
            (word,) = struct.unpack("<I", uc.mem_read(address, 4))
            found["all"] += 1
            for name, encodings in KINDS.items():
                found[name] += any(word & mask == value for mask, value in encodings)

        hook = self.uc.hook_add(unicorn.UC_HOOK_CODE, see)
        self.uc.ctl_flush_tb()  # what has run before has no hook
        call()
        self.uc.hook_del(hook)
        return found
