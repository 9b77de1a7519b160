"""Find known objects in calibrated pictures: hypotheses, verification and the next view.

`localize` searches poses (`search`), refines them on the edges of the pictures (`edges`,
`refining`) and judges them (`judging`), round after round (`search_rounds`). Then it checks the
camera poses on what was found (`rig_noise`, `corrected_rig`), and refines all accepted poses
together (`refining_together`). `next_views` chooses from where to look next.
"""

import lazy_loader as _lazy_loader

# `__init__.pyi` lists the names and their modules.
__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
