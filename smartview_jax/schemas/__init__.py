"""Define the contents of files by typed schemas with units and ranges; errors name the entry.

Most modules in this folder import pydantic, which takes a tenth of a second. Therefore each name is
imported when it is first used, as in `schemas.validate_content(content, schemas.DATASET_SCHEMA)`.
"""

import lazy_loader as _lazy_loader

# `__init__.pyi` lists the names and their modules, for type checkers and editors too.
__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
