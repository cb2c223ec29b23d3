"""A drawn world with exact truth: a needle as a function of time before two distorted, noisy cameras."""
