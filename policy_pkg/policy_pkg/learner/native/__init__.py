"""The learner's calls into the compiled kernels (policy_pkg.native), as functions to autograd."""
