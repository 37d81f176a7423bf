"""The API of `import lidardesign`: runs, designs and scores as whole steps."""
