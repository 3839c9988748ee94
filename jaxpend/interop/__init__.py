"""Doors to other tools, one file each: all that knows of a neighbour is here.

``gymnasium`` (with ``episodes``) and ``brax`` are our environment for other trainers;
``stable_baselines3`` (with ``tensors``) reads their policies; ``csv`` reads and writes recorded
runs; ``numpy``, ``onnx``, ``c`` and ``realaigym`` write a controller for where there is no jax.

Those four print one thing, a ``program``: one step of the controller as plain arithmetic.
``trace`` makes it. It lets jax record the step as a list of primitive operations, ``translate``
goes through that list, and ``rules`` says what each primitive becomes, with ``sums`` for those
that combine many entries into one. What no rule is for is refused, for all printers alike. ``c``
prints in several kinds of ``arithmetic``, one of which is ``pairs`` of floats.
"""
