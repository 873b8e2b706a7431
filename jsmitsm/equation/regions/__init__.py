"""Problems with several regions: an equation for each, conditions on their interfaces."""
