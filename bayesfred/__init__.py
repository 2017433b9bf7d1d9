"""Posterior of an imaging system's field distortion: the public names.

`__init__.pyi` says where each one lives.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
