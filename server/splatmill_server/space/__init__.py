"""The space that records occupy in storage: how much, whose, and how it becomes free again."""
