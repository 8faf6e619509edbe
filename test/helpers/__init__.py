"""What several tests share: objects and pushes, random cases, an exact depth renderer, a cell played over topics, paths."""
