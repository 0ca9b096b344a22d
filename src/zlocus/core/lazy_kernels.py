"""Kernels that cost little until they are called, and compiled kernels that are read from disk in a short way.

A run calls about thirty kernels, which contain the code of two hundred others. Numba makes an object for each of them
on import, fills its tables for compiling before it reads the first compiled kernel, and reads with each kernel a second
form of it that only the compiler needs. Here all of this waits until something asks for it.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from functools import update_wrapper
from typing import Any, NamedTuple

from llvmlite import binding
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult
from numba.core.environment import Environment, lookup_environment
from numba.core.runtime import rtsys

# Makes the dispatchers one at a time: two for one function would be two different types.
_MAKING = threading.RLock()


class LazyKernel:
    """A kernel whose Numba dispatcher is made when it is called, or when a kernel that contains it is compiled."""

    def __init__(self, function: Callable[..., Any], compiled: Callable[[Callable[..., Any]], Any]) -> None:
        """A kernel. function : its plain loops; compiled : makes its dispatcher."""
        update_wrapper(self, function)
        self.py_func = function
        self._compiled = compiled

    def __call__(self, *arguments: Any) -> Any:
        """The result of the compiled kernel."""
        return self.dispatcher(*arguments)

    def __getattr__(self, name: str) -> Any:
        """Everything else as the dispatcher has it: `dispatcher` itself is made by the first request."""
        if name != "dispatcher":
            # Asking for the dunder names of protocols (`__array__` and the like) must not make a dispatcher.
            if name.startswith("__"):
                raise AttributeError(name)
            return getattr(self.dispatcher, name)
        with _MAKING:
            if "dispatcher" not in self.__dict__:
                self.__dict__["dispatcher"] = self._compiled(self.py_func)
        return self.__dict__["dispatcher"]

    def __reduce__(self) -> str:
        """Pickled by name, as functions are."""
        return self.py_func.__qualname__


class KeptLibrary(JITCodeLibrary):
    """Machine code that was read from disk. Its LLVM module is parsed when another kernel is linked with it."""

    _bitcode: bytes | None = None

    @classmethod
    def of(cls, codegen: Any, kept: tuple[str, str, tuple[bytes, bytes]]) -> KeptLibrary:
        """The library that `serialize_using_object_code` has written. kept : name, "object", and both forms of it."""
        name, _, (machine_code, bitcode) = kept
        library = cls(codegen, name)
        library.enable_object_caching()
        library._set_compiled_object(machine_code)
        library._finalize_final_module()
        library._bitcode = bitcode
        return library

    def _get_module_for_linking(self) -> Any:
        if self._bitcode is not None:
            self._shared_module = binding.parse_bitcode(self._bitcode)
            self._codegen._engine._load_defined_symbols(self._shared_module)
            self._bitcode = None
        return super()._get_module_for_linking()


class KeptEnvironment(NamedTuple):
    """What machine code needs of a Python function that it contains.

    module : of the function; constants : Python objects that it uses; name : under which the machine code has it.
    """

    module: str
    constants: list[Any]
    name: str

    @classmethod
    def of(cls, environment: Environment) -> KeptEnvironment:
        """What is kept of an environment."""
        return cls(environment.globals["__name__"], environment.consts, environment.env_name)

    def environment(self) -> Environment:
        """The environment, without an import of its module: only Python objects would look at the module's names, and
        kernels have none. Many of these modules are parts of Numba's compiler."""
        found = lookup_environment(self.name)
        if found is None:
            module = sys.modules.get(self.module)
            found = Environment({"__name__": self.module} if module is None else module.__dict__)
            found.consts[:] = self.constants
            found.env_name = self.name
            Environment._memo[self.name] = found
        return found


class KeptKernel(CompileResultCacheImpl):
    """Turns a compiled kernel into what is kept on disk, and back."""

    def reduce(self, cres: CompileResult) -> tuple[Any, ...]:
        """What is kept: see `CompileResult._reduce`, with environments that can be read without their modules."""
        *kept, environments = cres._reduce()
        return (*kept, tuple(KeptEnvironment.of(each) for each in environments))

    def rebuild(self, target_context: Any, payload: tuple[Any, ...]) -> CompileResult:
        """The compiled kernel. payload : see `reduce`."""
        try:
            return self._in_short(target_context, *payload)
        except (AttributeError, TypeError):  # another version of Numba that has changed inside: its own way, slowly
            target_context.refresh()
            *kept, environments = payload
            return CompileResult._rebuild(target_context, *kept, tuple(each.environment() for each in environments))

    def _in_short(self, target_context: Any, *payload: Any) -> CompileResult:
        library, fndesc, env, signature, objectmode, lifted, typeann, reload_init, kept_environments = payload
        for prepare in reload_init:
            prepare()
        library = KeptLibrary.of(target_context.codegen(), library)
        # Names that Numba would find in the module; it asks for no other ones until it links the library with another.
        library._codegen._engine._defined_symbols |= {fndesc.llvm_func_name, fndesc.llvm_cpython_wrapper_name}
        entry_point = target_context.get_executable(library, fndesc, env)
        environments = tuple(each.environment() for each in kept_environments)
        for each in environments:
            library.codegen.set_env(each.env_name, each)
        return CompileResult(
            target_context=target_context, typing_context=target_context.typing_context, library=library,
            environment=env, entry_point=entry_point, fndesc=fndesc, type_annotation=typeann, signature=signature,
            objectmode=objectmode, lifted=lifted, typing_error=None, call_helper=None, metadata=None,
            reload_init=reload_init, referenced_envs=environments,
        )  # fmt: skip


class KernelFiles(FunctionCache):
    """The compiled forms of one kernel on disk."""

    _impl_class = KeptKernel

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        """The compiled kernel for the types of its arguments; None where it was not kept.

        Unlike Numba's own, this leaves the tables for compiling empty. The compiler fills them itself.
        """
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)
        return None
