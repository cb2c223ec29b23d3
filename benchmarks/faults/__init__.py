"""Every fault that can be injected on this machine, and what a subscriber in another process saw of it."""
