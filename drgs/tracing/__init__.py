"""The engine: Gaussians and rays in, composited images and their derivatives out.

Importing it chooses the backend, so that the modules in here, and those that use them, simply import `drjit`: `import
drgs` has pointed Dr.Jit to a libLLVM before (runtime/libllvm.py), and on a machine that has none the import raises.
"""

from drgs import runtime

runtime.backend()
