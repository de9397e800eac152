"""Posed views with their masks: dataset folders, label images, soft masks, and what labels say of classes."""
