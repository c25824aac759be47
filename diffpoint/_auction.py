"""The schedule of the auction for the earth mover's distance, which the kernels for CPU and CUDA share."""

SCALING = 5.0  # factor of the bid increment (epsilon) between phases
COARSEST = 0.1  # first epsilon, relative to the largest cost that the extent of the pair allows
# The smallest epsilon, relative to the accepted gap: a phase leaves a mean gap of 0.4 to 0.6 epsilon.
ENOUGH = 1.5
# Limit on the bids of a pair, per point of its larger set; after it the remaining points are matched in order.
BIDS_PER_PERSON = 4000
# Costs beyond this, and prices, which may exceed them, come near that of the padding. In float32, squares overflow.
LARGEST_COST = 1e18
# What the largest cost of a pair is taken for if it is less: increments relative to it stay normal numbers of float32.
SMALLEST_COST = 1e-30
FAR = 1e30  # price of padding
# The smallest bid increment, relative to the largest cost of the pair: the resolution of prices of so many bytes.
RESOLUTION = {4: 2e-6, 8: 1e-12}
