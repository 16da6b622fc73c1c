"""The truth of an export: the lines of ``truth.jsonl``, and the tables, splits and data card made of them."""
