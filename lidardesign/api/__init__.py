"""What `import lidardesign` offers: runs, designs and scores as whole steps."""
