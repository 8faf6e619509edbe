"""What a node hears of objects, tables, depth images and pushes."""
