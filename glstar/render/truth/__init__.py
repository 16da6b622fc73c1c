"""Labels of a frame: its line of ground truth and the table of its keys, trails, masks, and viewing conditions."""
