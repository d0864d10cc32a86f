//! Small systems of linear equations.

/// Solves `matrix` x = `right` by elimination with the largest pivot; `None` if a pivot is at most `least`, as it is for
/// dependent equations.
///
/// ```
/// use carff_base::linear::solve;
/// assert_eq!(solve([[0.0, 2.0], [1.0, 1.0]], [4.0, 5.0], 1e-9), Some([3.0, 2.0]));
/// assert_eq!(solve([[1.0, 2.0], [2.0, 4.0]], [4.0, 5.0], 1e-9), None);
/// ```
pub fn solve<const N: usize>(mut matrix: [[f64; N]; N], mut right: [f64; N], least: f64) -> Option<[f64; N]> {
    for column in 0..N {
        let pivot = (column..N).max_by(|&a, &b| matrix[a][column].abs().total_cmp(&matrix[b][column].abs()))?;
        if matrix[pivot][column].abs() <= least {
            return None;
        }
        matrix.swap(column, pivot);
        right.swap(column, pivot);
        let (pivot_row, pivot_right) = (matrix[column], right[column]);
        for (row, right) in matrix.iter_mut().zip(&mut right).skip(column + 1) {
            let factor = row[column] / pivot_row[column];
            row.iter_mut().zip(pivot_row).for_each(|(term, of_pivot)| *term -= factor * of_pivot);
            *right -= factor * pivot_right;
        }
    }
    let mut found = [0.0; N];
    for row in (0..N).rev() {
        let known: f64 = (row + 1..N).map(|k| matrix[row][k] * found[k]).sum();
        found[row] = (right[row] - known) / matrix[row][row];
    }
    Some(found)
}
