"""The command `gsseg`."""
