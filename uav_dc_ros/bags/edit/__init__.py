"""New bags from the messages of others: merged, filtered, converted."""
