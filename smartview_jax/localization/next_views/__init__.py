"""Choose the next view of objects that were found."""
