"""Files that cameras of a dataset come from, one module for each format behind one table."""
