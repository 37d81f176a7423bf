"""What several formats share: names, poses, columns, XML, and reading back."""
