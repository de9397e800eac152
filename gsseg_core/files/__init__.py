"""Files in and out: opened with care, read within limits, written whole or not at all."""
