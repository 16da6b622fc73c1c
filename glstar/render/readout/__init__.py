"""What rolling shutters and stacks record of a trail: times of rows, short exposures, and pieces of trails."""
