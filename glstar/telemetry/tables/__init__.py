"""Tables of text, Parquet and Excel: in glstar's own columns, or in those of other programs by a column map."""
