// A program of bench_rivals.py: the semantic voxel blocks of pySLAM (cpp/volumetric) fuse the points of IN into OUT.
//
//     pyslam votes|probabilities IN OUT
//
// bench_rivals.py says what IN, OUT and the standard output hold. It compiles this file with the headers of a checkout
// that the user names; no part of pySLAM is here.

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <string>
#include <vector>

#include <malloc.h>
#include <sys/resource.h>
#include <tbb/global_control.h>

#include "voxel_block_semantic_grid.h"

template <typename T> std::vector<T> read(std::ifstream &file, size_t n = 1) {
    std::vector<T> values(n);
    file.read(reinterpret_cast<char *>(values.data()), n * sizeof(T));
    return values;
}

template <typename T> void write(std::ofstream &file, const T *values, size_t n = 1) {
    file.write(reinterpret_cast<const char *>(values), n * sizeof(T));
}

double cpu_ms() {
    rusage used;
    getrusage(RUSAGE_SELF, &used);
    return 1e3 * (used.ru_utime.tv_sec + used.ru_stime.tv_sec) + 1e-3 * (used.ru_utime.tv_usec + used.ru_stime.tv_usec);
}

long status(const std::string &name) { // bytes of VmRSS or VmHWM
    std::ifstream file("/proc/self/status");
    for (std::string word; file >> word;)
        if (word == name + ":") {
            long kilobytes;
            file >> kilobytes;
            return 1024 * kilobytes;
        }
    return 0;
}

template <typename Grid> int fuse(const char *in, const char *out) {
    std::ifstream file(in, std::ios::binary);
    const double voxel_size = read<double>(file)[0];
    const auto head = read<int64_t>(file, 2); // K, frames
    std::vector<std::vector<double>> points;
    std::vector<std::vector<int>> labels;
    for (int64_t frame = 0; frame < head[1]; ++frame) {
        const size_t n = read<int64_t>(file)[0];
        read<double>(file, 3); // the camera's position
        points.push_back(read<double>(file, 3 * n));
        labels.push_back(read<int>(file, n));
    }

    size_t most = 0;
    for (const auto &frame : labels)
        most = std::max(most, frame.size());
    const std::vector<float> colors(3 * most); // without colours it takes no labels

    Grid grid(voxel_size, 8);
    malloc_trim(0);
    std::ofstream("/proc/self/clear_refs") << 5;
    const long before = status("VmRSS");
    std::string ms;
    for (size_t frame = 0; frame < points.size(); ++frame) {
        const double started = cpu_ms();
        grid.template integrate_raw<double, float, std::nullptr_t, int>(
            points[frame].data(), labels[frame].size(), colors.data(), labels[frame].data());
        ms += (frame ? ", " : "") + std::to_string(cpu_ms() - started);
    }
    std::printf("{\"ms\": [%s], \"bytes\": %ld, \"peak_bytes\": %ld}\n", ms.c_str(), status("VmRSS") - before,
                status("VmHWM") - before);

    const auto means = grid.get_points(); // the mean of a voxel's points lies in it
    const auto classes = grid.get_ids().first; // in the same order
    const int64_t n = means.size();
    std::ofstream written(out, std::ios::binary);
    write(written, &n);
    write(written, means.data(), n);
    write(written, classes.data(), n);
    return written ? 0 : 1;
}

int main(int count, char **words) {
    const tbb::global_control one(tbb::global_control::max_allowed_parallelism, 1);
    const std::string kind = count == 4 ? words[1] : "";
    if (kind == "votes")
        return fuse<volumetric::VoxelBlockSemanticGrid>(words[2], words[3]);
    if (kind == "probabilities")
        return fuse<volumetric::VoxelBlockSemanticProbabilisticGrid>(words[2], words[3]);
    std::fprintf(stderr, "usage: pyslam votes|probabilities IN OUT\n");
    return 2;
}
