"""Records in files and tables: CSV, HDF5, MATLAB and pandas, with the columns' units and checks."""
