"""The wire: keys, messages and the Zenoh publisher; docs/wire.md is its contract."""
