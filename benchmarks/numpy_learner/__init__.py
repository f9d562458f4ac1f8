"""The learner as it was in numpy, without autograd and a compiled unroll; to compare with."""
