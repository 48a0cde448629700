// What examples/cpp uses of rclcpp, doing nothing: the ROS 2 wheels have none. Enough to check and link its messages.
#pragma once

#include <chrono>
#include <cstdio>
#include <future>
#include <memory>
#include <string>

#define RCLCPP_INFO(logger, ...) ((void)(logger), std::printf(__VA_ARGS__))
#define RCLCPP_ERROR(logger, ...) ((void)(logger), std::printf(__VA_ARGS__))

namespace rclcpp
{
enum class FutureReturnCode { SUCCESS, INTERRUPTED, TIMEOUT };
struct Logger {};
struct Node
{
  explicit Node(const std::string &) {}
  Logger get_logger() const {return {};}
};
inline void init(int, char const * const *) {}
inline bool shutdown() {return true;}
template<typename Future>
FutureReturnCode spin_until_future_complete(std::shared_ptr<Node>, const Future &, std::chrono::seconds)
{
  return FutureReturnCode::TIMEOUT;
}
}  // namespace rclcpp
