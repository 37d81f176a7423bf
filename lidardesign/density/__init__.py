"""The learned density over design space: fields, visibility, target, flow, learning."""
