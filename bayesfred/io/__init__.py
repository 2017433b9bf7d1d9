"""Bytes in and out: files, locks and what a file must be before it is read."""
