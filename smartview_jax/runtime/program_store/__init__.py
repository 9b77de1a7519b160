"""Keep compiled programs on disk with an index, so that later processes need not trace again.

JAX's own cache on disk finds a program by its text (HLO). To obtain the text, a function is traced
and lowered, which takes three times as long as reading the compiled program. This package skips
that work: it saves two to three seconds when a command is run again, and nothing else depends on
it. If this folder is deleted, `compilation` uses JAX's own cache alone; a test covers that case.

Two files are kept for each program, in the folder of JAX's cache and under the same settings
(`compilation_cache`):

- an index entry, called the trace, keyed by sources, versions and argument shapes (`identity`). It
  holds the structure of the result, and the name and digest of the program's file;
- the program: the executable, keyed by its HLO text.

After a change of the sources only the trace is written again, unless the text has changed too. Both
files may contain only listed classes (`safe_pickle`). They are read only from a folder that nobody
but the user can write to, because the executable is run.

These cases are left to JAX's own cache:

- arguments that contain a class or function defined by the user;
- arrays on several devices, or on a device other than the first CPU;
- programs that call Python while they run;
- settings of JAX for checks or for another precision (`jax_debug_nans`, for example).
"""

from .store import READ_EVENT as READ_EVENT
from .store import ProgramStore as ProgramStore
from .store import forget_programs as forget_programs
