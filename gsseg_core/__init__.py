"""Segment trained 3D Gaussian Splatting scenes: from posed 2D masks to a class for every Gaussian.

>>> from gsseg_core import Dataset, EMLearner, GaussianScene, Segmentation, export_classes
>>> scene, data = GaussianScene.load("scene.ply"), Dataset("dataset")  # doctest: +SKIP
>>> learner = EMLearner(scene, data.num_classes)  # doctest: +SKIP
>>> for view in data.views("train"):  # doctest: +SKIP
...     learner.observe(view)
>>> codes = learner.fit().codes_  # doctest: +SKIP
>>> result = Segmentation.from_codes(scene, codes, data.class_names, evidence=learner.evidence())  # doctest: +SKIP
>>> export_classes(scene, result, "classes")  # doctest: +SKIP
"""

import lazy_loader

# The names are in `__init__.pyi`. Each is loaded on first use: compiled kernels and PyTorch take longer to import than
# all the rest.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
