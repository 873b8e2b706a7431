"""Problems with several regions solved: the same steps as for one, on rows of all regions and of where they meet."""
