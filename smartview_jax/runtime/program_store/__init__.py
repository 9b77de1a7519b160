"""Keep compiled programs on disk together with their traces, so that no later process traces again.

JAX's own cache on disk finds a program by its text. To make the text, a function is traced and
lowered, which takes three times as long as reading the compiled program. This room skips that work:
it saves two to three seconds of a command that has been run before, and nothing else depends on it.
Delete this folder, and `compilation` uses JAX's own cache alone; a test runs the package so.

Two files are kept for each program, in the folder of JAX's cache and under the same settings
(`compilation_cache`):

- the trace, found by everything that decides the text (sources, versions, argument shapes:
  `identity`): how the result is put together, and the name and digest of the program;
- the program, found by its text: the executable.

After a change of the sources only the trace is written again, unless the text has changed, too.
Both are read through lists of the classes that may be in them (`safe_pickle`), and only from a
folder and files that nobody but the user can write: an executable that is read is run.

What is left to JAX alone:

- arguments that hold a class or a function of a user;
- arrays on several devices, or on another device than the first CPU;
- programs that call Python while they run;
- JAX that was told to check, or to compute otherwise than it does by itself.
"""

from .store import READ_EVENT as READ_EVENT
from .store import ProgramStore as ProgramStore
from .store import forget_programs as forget_programs
